"""`gsplat.rasterization` on kgs: the same arguments, order and results, for trainers that are written for gsplat."""

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor

from kgs.backends import Backend, get_backend
from kgs.geometry.types import RasterOptions
from kgs.stages import blend, project, rasterize

from .arguments import as_kgs, check_words, refuse
from .meta import Pairs


def rasterization(  # noqa: D417 - arguments without effect are described together
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = RasterOptions.near_plane,
    far_plane: float = 1e10,
    radius_clip: float = RasterOptions.radius_clip,
    eps2d: float = RasterOptions.eps2d,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = RasterOptions.tile_size,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    macro_tile: bool = False,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    lidar_coeffs: Any = None,
    external_distortion_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    ut_params: Any = None,
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any = None,
    *,
    channel_chunk: int = 32,
    pixel_centers: str = "half",
    alpha_threshold: float = RasterOptions.alpha_threshold,
    transmittance_stop: float = RasterOptions.transmittance_stop,
    max_bytes: int | None = RasterOptions.max_bytes,
    backend: str | Backend = "auto",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians in C cameras; a drop-in for `gsplat.rasterization` of gsplat 1.6, and of 1.5 by name.

    Differentiable in all tensors, `viewmats` and `Ks` included. For near_plane, radius_clip, eps2d, alpha_threshold,
    transmittance_stop and max_bytes see :class:`kgs.RasterOptions`.

    tile_size, segmented, macro_tile, channel_chunk, ut_params and renderer_config change nothing. sparse_grad,
    distributed, with_ut, with_eval3d, return_normals, global_z_order, rays, radial_coeffs, tangential_coeffs,
    thin_prism_coeffs, ftheta_coeffs, lidar_coeffs, external_distortion_coeffs, rolling_shutter, viewmats_rs,
    extra_signals and extra_signals_sh_degree are accepted only at gsplat's defaults. The page "Coming from gsplat" has
    the reasons, and the differences argument by argument.

    Convention:
        World-to-camera matrices, OpenCV axes; quaternions w, x, y, z; the first pixel's centre at (0.5, 0.5).

    Args:
        means: centres in world units, `(N, 3)`.
        quats: of any norm from 1e-38 on, `(N, 4)`; None where `covars` are given.
        scales: standard deviations in world units, > 0, `(N, 3)`; None where `covars` are given.
        opacities: in [0, 1], `(N,)`, or `(C, N)` for one value per camera.
        colors: without `sh_degree` any features, `(N, D)` or `(C, N, D)`; with it harmonics `(N, K, 3)`. May be None
            where `render_mode` is "D" or "ED".
        viewmats: `(C, 4, 4)`.
        Ks: intrinsics in pixels, `(C, 3, 3)`; skew is followed by pinhole cameras alone.
        width: of the images in pixels.
        height: of the images in pixels.
        far_plane: Gaussians with z >= far_plane are left out; 1e10 or more: none are.
        sh_degree: degree 0 to 3 of the harmonics to use; K is at least (sh_degree + 1)^2. None: `colors` as they are.
        packed: the layout of `meta`, see below; it changes nothing else.
        backgrounds: `(C, D)`, or None for 0. Not used without colours.
        render_mode: "RGB" (the colours), "D" (sum of w z), "ED" (that over alpha), "RGB+D" or "RGB+ED".
        absgrad: `backward` also sets `meta["means2d"].absgrad`, see :class:`kgs.RasterOptions`.
        rasterize_mode: "classic", or "antialiased": see :class:`kgs.RasterOptions`.
        camera_model: "pinhole", "fisheye" (equidistant) or, up to degree 0, "ortho".
        covars: covariances in place of `quats` and `scales`, `(N, 3, 3)`: their upper triangles, see
            :func:`kgs.geometry.covariance.covariance_factors`.
        pixel_centers: "half" as in gsplat, or "integer": the first pixel's centre at (0, 0).
        backend: "auto", "torch", or in float32 "numba" (on a CPU) or "triton" (on a GPU), see `kgs.backends`.

    Returns:
        Renders `(C, H, W, D)`, where a depth is the last channel; alphas `(C, H, W, 1)`; and a dict `meta`. Of the M
        visible pairs (camera, Gaussian) it has depths and opacities `(M,)`; means2d `(M, 2)` in the pixels of `Ks`,
        whose gradient `retain_grad()` keeps, as in gsplat; radii `(M, 2)`, int32, 3.33 standard deviations along x and
        y in pixels, rounded up; conics `(M, 3)`; batch_ids, camera_ids and gaussian_ids `(M,)`. With `packed=False`
        they are `(C, N)` and so on, 0 where a Gaussian is not visible, and the ids are None. Also width, height,
        tile_size, tile_width, tile_height, n_batches and n_cameras.

    Raises:
        TypeError: an argument is not a tensor, or of another dtype or device.
        ValueError: shapes do not match, an option is out of range, or kgs does not do what is asked for.
        ModuleNotFoundError: the backend is numba or triton, and it is not installed.

    Examples:
        >>> import torch, kgs
        >>> k = torch.tensor([[[20.0, 0.0, 16.0], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]]])
        >>> renders, alphas, meta = kgs.rasterization(
        ...     means=torch.tensor([[0.0, 0.0, 2.0]]), quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        ...     scales=torch.full((1, 3), 0.2), opacities=torch.tensor([0.9]), colors=torch.rand(1, 5),
        ...     viewmats=torch.eye(4)[None], Ks=k, width=32, height=24, render_mode="RGB+ED")
        >>> renders.shape, alphas.shape, meta["means2d"].tolist()
        (torch.Size([1, 24, 32, 6]), torch.Size([1, 24, 32, 1]), [[16.0, 12.0]])
    """
    refuse(locals())  # all arguments by name
    check_words(render_mode, rasterize_mode, camera_model, sh_degree)
    options = RasterOptions(
        tile_size=tile_size,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        antialiased=rasterize_mode == "antialiased",
        alpha_threshold=alpha_threshold,
        transmittance_stop=transmittance_stop,
        max_bytes=max_bytes,
        absgrad=absgrad,
    )
    endless = options.far_plane >= 1e10  # the default
    options = dataclasses.replace(options, tile_size=None, far_plane=math.inf if endless else options.far_plane)
    has_image = "RGB" in render_mode
    gaussians, cameras, features_per_camera = as_kgs(
        means,
        quats,
        scales,
        covars,
        opacities,
        colors,
        viewmats,
        Ks,
        size=(height, width),
        lens=camera_model,
        pixel_centers=pixel_centers,
        has_image=has_image,
        sh_degree=sh_degree,
    )
    is_shared = has_image and features_per_camera is None
    table = get_backend(backend, means.device)
    projected = project(gaussians, cameras, options=options, colors=is_shared, backend=table)
    pairs = Pairs(projected, len(viewmats), len(gaussians), packed)
    half = 0.5 if pixel_centers == "half" else 0.0
    means2d = pairs.spread(projected.means2d + half)
    projected = dataclasses.replace(projected, means2d=pairs.gathered(means2d) - half)
    features = [projected.colors] if is_shared else []
    if features_per_camera is not None:
        features.append(features_per_camera.flatten(0, 1).index_select(0, pairs.ids))
    if render_mode.endswith("D"):
        features.append(projected.depths[:, None])
    hook = pairs.absgrad_hook(means2d) if absgrad else None
    composited = rasterize(projected, torch.cat(features, 1), options, table, absgrad_hook=hook)
    alphas = 1.0 - composited.transmittance
    images = list(composited.features.split([x.shape[1] for x in features], 1))
    if has_image:
        images[0] = blend(images[0], composited.transmittance, backgrounds, table, "backgrounds")
    if render_mode.endswith("ED"):
        images[-1] = images[-1] / alphas.clamp_min(1e-10)
    tile = composited.tile_size
    meta = pairs.meta(means2d) | {"width": width, "height": height, "tile_size": tile}
    meta |= {"tile_width": -(-width // tile), "tile_height": -(-height // tile)}
    return torch.cat(images, 1).permute(0, 2, 3, 1), alphas.permute(0, 2, 3, 1), meta
