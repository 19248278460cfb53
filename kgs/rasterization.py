"""gsplat's call in tensors, for trainers that have it: the same names, order and results, in torch."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from .camera import cameras
from .projection import project
from .raster import composite
from .renderer import blend
from .types import SH_SIZES, Gaussians, RasterOptions

__all__ = ["rasterization"]

_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
# what gsplat takes and kgs does not: the values with which it does nothing
_HARMLESS: dict[str, tuple[Any, ...]] = {
    "radius_clip": (0,),
    "sparse_grad": (False,),
    "absgrad": (False,),
    "rasterize_mode": ("classic",),
    "distributed": (False,),
    "camera_model": ("pinhole",),
    "covars": (None,),
    "with_ut": (False,),
    "with_eval3d": (False,),
    "radial_coeffs": (None,),
    "tangential_coeffs": (None,),
    "thin_prism_coeffs": (None,),
    "ftheta_coeffs": (None,),
    "viewmats_rs": (None,),
}


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = RasterOptions.near_plane,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = RasterOptions.eps2d,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = RasterOptions.tile_size,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    *,
    pixel_centers: str = "half",
    alpha_threshold: float = RasterOptions.alpha_threshold,
    transmittance_stop: float = RasterOptions.transmittance_stop,
    max_bytes: int = RasterOptions.max_bytes,
    backend: str = "auto",
    **others: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians in C pinhole cameras; a drop-in for `gsplat.rasterization`.

    Differentiable in all tensors, `viewmats` and `Ks` included. For other lenses and outputs see `GaussianRenderer`.

    Convention:
        World-to-camera matrices, OpenCV axes; quaternions w, x, y, z; the first pixel's centre at (0.5, 0.5).

    Args:
        means: centres in world units, `(N, 3)`.
        quats: of any non-zero norm, `(N, 4)`.
        scales: standard deviations in world units, > 0, `(N, 3)`.
        opacities: in [0, 1], `(N,)` or `(C, N)`.
        colors: without `sh_degree` any features, `(N, D)` or `(C, N, D)`; with it harmonics `(N, K, 3)`.
        viewmats: `(C, 4, 4)`.
        Ks: intrinsics in pixels, `(C, 3, 3)`.
        width: of the images in pixels.
        height: of the images in pixels.
        near_plane: only centres with z > near_plane are drawn; world units.
        far_plane: accepted at 1e10 and above: nothing is cut.
        radius_clip: accepted at 0.
        eps2d: variance in px^2 added to each footprint.
        sh_degree: degree 0 to 3 of the harmonics to use; K is at least (sh_degree + 1)^2. None: `colors` as they are.
        packed: accepted, without effect: `meta` is always packed.
        tile_size: changes the speed alone.
        backgrounds: `(C, D)`, or None for 0.
        render_mode: "RGB" (the colours), "D" (sum of w z), "ED" (that over alpha), "RGB+D" or "RGB+ED".
        sparse_grad: accepted at False, as `absgrad`, `distributed`, `with_ut` and `with_eval3d`.
        absgrad: see `sparse_grad`.
        rasterize_mode: accepted at "classic".
        channel_chunk: accepted, without effect.
        distributed: see `sparse_grad`.
        camera_model: accepted at "pinhole".
        segmented: accepted, without effect.
        covars: accepted at None, as `radial_coeffs`, `tangential_coeffs`, `thin_prism_coeffs` and others of gsplat.
        with_ut: see `sparse_grad`.
        with_eval3d: see `sparse_grad`.
        pixel_centers: "half" as in gsplat, or "integer": the first pixel's centre at (0, 0).
        alpha_threshold: see :class:`kgs.RasterOptions`, as for the next two.
        transmittance_stop: light below it counts as 0.
        max_bytes: bound for the working memory.
        backend: "auto", or the name of one, see `kgs.backends`.
        others: see `covars`.

    Returns:
        Renders `(C, H, W, D)`, where a depth is the last channel; alphas `(C, H, W, 1)`; and a dict `meta` of the M
        pairs (camera, Gaussian) that were seen: camera_ids, gaussian_ids, radii, depths, opacities, all `(M,)`,
        means2d `(M, 2)` in the pixels of `Ks`, which keeps its `.grad`, conics `(M, 3)`; width, height, tile_size,
        n_cameras.

    Raises:
        TypeError: a tensor is none, or of another dtype or device.
        ValueError: shapes or options do not fit, or an argument of gsplat's asks for what kgs does not do.

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
    given = dict(others, radius_clip=radius_clip, sparse_grad=sparse_grad, absgrad=absgrad, covars=covars)
    given |= dict(rasterize_mode=rasterize_mode, distributed=distributed, camera_model=camera_model)
    _refuse(given | dict(with_ut=with_ut, with_eval3d=with_eval3d), far_plane)
    if render_mode not in _MODES:
        raise ValueError(f"render_mode: expected one of {_MODES}, got {render_mode!r}")
    posed = cameras(viewmats, Ks, width, height, pixel_centers)
    count, n = posed.batch_size, means.shape[0] if isinstance(means, Tensor) and means.ndim else 0
    colors, of_each = _check_colors(colors, sh_degree, count, n)
    own = isinstance(colors, Tensor) and of_each
    gaussians = Gaussians(means, quats, scales, opacities, colors[0] if own else colors)
    image, depth = "RGB" in render_mode, render_mode.rsplit("+")[-1] in ("D", "ED")
    projected = project(
        gaussians,
        posed,
        near_plane=near_plane,
        eps2d=eps2d,
        alpha_threshold=alpha_threshold,
        colors=image and not own,
        backend=backend,
    )
    half = 0.5 if pixel_centers == "half" else 0.0
    means2d = projected.means2d + half
    if means2d.requires_grad:
        means2d.retain_grad()
    projected = dataclasses.replace(projected, means2d=means2d - half)
    features = projected.colors
    if image and own:
        features = colors.flatten(0, 1).index_select(0, projected.camera_ids * n + projected.gaussian_ids)
    width_d = features.shape[1]
    if depth:
        features = torch.cat([features, projected.depths[:, None]], 1)
    result = composite(
        projected,
        features,
        tile_size=tile_size,
        alpha_threshold=alpha_threshold,
        transmittance_stop=transmittance_stop,
        max_bytes=max_bytes,
        backend=backend,
    )
    alphas = 1.0 - result.transmittance
    renders, depths = result.features[:, :width_d], result.features[:, width_d:]
    if image:
        if backgrounds is not None and tuple(backgrounds.shape) != (count, width_d):
            raise ValueError(f"backgrounds: expected shape ({count}, {width_d}), got {tuple(backgrounds.shape)}")
        renders = blend(renders, result.transmittance, backgrounds, "backgrounds")
    if render_mode.endswith("ED"):
        depths = depths / alphas.clamp_min(1e-10)
    meta = {
        "camera_ids": projected.camera_ids,
        "gaussian_ids": projected.gaussian_ids,
        "radii": projected.radii,
        "means2d": means2d,
        "depths": projected.depths,
        "conics": projected.conics,
        "opacities": projected.opacities,
        "width": width,
        "height": height,
        "tile_size": tile_size,
        "n_cameras": count,
    }
    return torch.cat([renders, depths], 1).permute(0, 2, 3, 1), alphas.permute(0, 2, 3, 1), meta


def _refuse(given: dict[str, Any], far_plane: float) -> None:
    """Raise an error that names the argument of gsplat's that asks for what kgs does not do."""
    for name, value in given.items():
        if name not in _HARMLESS:
            raise TypeError(f"rasterization: got an unexpected argument {name!r}")
        harmless = _HARMLESS[name]
        if isinstance(value, Tensor) or value not in harmless:
            shown = f"a tensor {tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)
            raise ValueError(f"{name}: expected {harmless[0]!r}, the one value that kgs supports, got {shown}")
    if not far_plane >= 1e10:
        raise ValueError(f"far_plane: expected 1e10 or more, kgs cuts nothing far away, got {far_plane}")


def _check_colors(colors: Tensor, sh_degree: int | None, count: int, n: int) -> tuple[Tensor, bool]:
    """The colours for `Gaussians`, and whether each camera has its own."""
    if not isinstance(colors, Tensor):
        raise TypeError(f"colors: expected a torch.Tensor, got {type(colors).__name__}")
    shape = tuple(colors.shape)
    if sh_degree is None:
        if shape[:-1] not in ((n,), (count, n)):
            raise ValueError(f"colors: expected shape ({n}, D) or ({count}, {n}, D) without sh_degree, got {shape}")
        return colors, colors.ndim == 3
    if sh_degree not in range(len(SH_SIZES)):
        raise ValueError(f"sh_degree: expected 0 to {len(SH_SIZES) - 1} or None, got {sh_degree}")
    least = (sh_degree + 1) ** 2
    if len(shape) != 3 or shape[0] != n or shape[1] < least or shape[2] != 3:
        raise ValueError(f"colors: expected shape ({n}, K, 3) with K >= {least} for sh_degree {sh_degree}, got {shape}")
    return colors[:, :least], False
