"""gsplat's own torch code as an oracle: its projection and harmonics, and the sum over the layers of each pixel."""

import torch
from gsplat.cuda import _torch_impl as gsplat


def gsplat_render(
    values,
    size,
    sh_degree=None,
    render_mode="RGB",
    rasterize_mode="classic",
    radius_clip=0.0,
    backgrounds=None,
    **options,
):
    """Renders, alphas and meta of C cameras; `values` has gsplat's tensors by name, `size` is (height, width).

    meta: means2d `(C, N, 2)`; centres `(C, N, H W, 2)`, a copy of them for each pixel; radii as gsplat says; `lies`,
    which Gaussians are drawn: all between the planes that are large enough, also those beside the image.
    """
    covars = values.get("covars")
    if covars is None:
        covars, _ = gsplat._quat_scale_to_covar_preci(values["quats"], values["scales"], True, False)
    else:
        covars = covars.triu() + covars.triu(1).mT  # as gsplat's call reads them
    pose, means = values["viewmats"], values["means"]
    compensated = rasterize_mode == "antialiased"
    found = gsplat._fully_fused_projection(
        means, covars, pose, values["Ks"], size[1], size[0], calc_compensations=compensated, **options
    )
    radii, means2d, depths, conics, compensations = found
    lies = (depths > 0.01) & (depths < options.get("far_plane", 1e10))
    if radius_clip:
        lies &= (radii > radius_clip).any(-1)
    opacities = values["opacities"] * (compensations if compensated else 1.0)
    shown = depths[..., None]
    if render_mode != "ED" and render_mode != "D":
        colors = values["colors"]
        if sh_degree is not None:
            directions = means - torch.inverse(pose)[:, None, :3, 3]
            colors = gsplat._spherical_harmonics(sh_degree, directions, colors.expand(len(pose), -1, -1, -1))
            colors = (colors + 0.5).clamp_min(0.0)
        colors = colors.expand(len(pose), *colors.shape[-2:])
        shown = torch.cat([colors, shown], -1) if "+" in render_mode else colors

    y, x = torch.meshgrid(*(torch.arange(s).to(means) + 0.5 for s in size), indexing="ij")
    pixels = torch.stack([x, y], -1).view(1, 1, -1, 2)
    centres = means2d[:, :, None].expand(-1, -1, pixels.shape[2], -1)
    if means2d.requires_grad:
        means2d.retain_grad()
        centres.retain_grad()
    dx, dy = (pixels - centres).unbind(-1)
    a, b, c = (q[..., None] for q in conics.unbind(-1))
    alphas = (opacities * lies)[..., None] * torch.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy)
    order = depths.detach().argsort(dim=1, stable=True)[..., None]  # copies of a Gaussian lie at the same depth
    alphas = alphas.gather(1, order.expand_as(alphas))
    shown = shown.gather(1, order.expand_as(shown))
    behind = torch.cumprod(torch.cat([torch.ones_like(alphas[:, :1]), 1 - alphas], 1), 1)
    image = torch.einsum("cnp,cnf->cpf", alphas * behind[:, :-1], shown)
    alpha = 1 - behind[:, -1, :, None]
    if backgrounds is not None:
        padded = torch.nn.functional.pad(backgrounds, (0, image.shape[-1] - backgrounds.shape[-1]))
        image = image + padded[:, None] * (1 - alpha)
    if render_mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp_min(1e-10)], -1)
    meta = {"means2d": means2d, "centres": centres, "radii": radii, "lies": lies, "gaussian_ids": None}
    meta |= {"height": size[0], "width": size[1], "n_cameras": len(pose)}
    return image.unflatten(1, size), alpha.unflatten(1, size), meta
