"""`gsplat.rasterization` on kgs: the same arguments, order and results, for trainers that are written for gsplat."""

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .camera import pinhole_cameras
from .renderer import blend
from .stages import composite, project
from .types import SH_SIZES, Gaussians, ProjectedGaussians, RasterOptions, check_tensor

_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
# Arguments of gsplat 1.5 and 1.6 that ask for what kgs does not do: the value at which each does nothing.
_NO_OPS: dict[str, Any] = {
    "radius_clip": 0,
    "sparse_grad": False,
    "absgrad": False,
    "rasterize_mode": "classic",
    "distributed": False,
    "camera_model": "pinhole",
    "covars": None,
    "with_ut": False,
    "with_eval3d": False,
    "return_normals": False,
    "global_z_order": True,
    "rays": None,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "ftheta_coeffs": None,
    "lidar_coeffs": None,
    "external_distortion_coeffs": None,
    "rolling_shutter": None,
    "viewmats_rs": None,
    "ut_params": None,
    "extra_signals": None,
    "extra_signals_sh_degree": None,
    "renderer_config": None,
}
_WITHOUT_EFFECT = ("macro_tile",)  # they change how gsplat works, not its result
_LARGEST_RADIUS = 2e9  # pixels, as an int32


def rasterization(  # noqa: D417 - arguments without effect are described together
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor | None,
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
    tile_size: int | None = RasterOptions.tile_size,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
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
    For near_plane, eps2d, tile_size, alpha_threshold, transmittance_stop and max_bytes see :class:`kgs.RasterOptions`.
    packed, channel_chunk, segmented and macro_tile have no effect. These arguments are accepted only at their no-op
    values: far_plane (1e10 or more), radius_clip, sparse_grad, absgrad, rasterize_mode, distributed, camera_model, and
    `others`, the further arguments of gsplat 1.5 and 1.6 by name.

    Convention:
        World-to-camera matrices, OpenCV axes; quaternions w, x, y, z; the first pixel's centre at (0.5, 0.5).

    Args:
        means: centres in world units, `(N, 3)`.
        quats: of any norm from 1e-38 on, `(N, 4)`.
        scales: standard deviations in world units, > 0, `(N, 3)`.
        opacities: in [0, 1], `(N,)` or `(C, N)`.
        colors: without `sh_degree` any features, `(N, D)` or `(C, N, D)`; with it harmonics `(N, K, 3)`. May be None
            where `render_mode` is "D" or "ED".
        viewmats: `(C, 4, 4)`.
        Ks: intrinsics in pixels, `(C, 3, 3)`.
        width: of the images in pixels.
        height: of the images in pixels.
        sh_degree: degree 0 to 3 of the harmonics to use; K is at least (sh_degree + 1)^2. None: `colors` as they are.
        backgrounds: `(C, D)`, or None for 0.
        render_mode: "RGB" (the colours), "D" (sum of w z), "ED" (that over alpha), "RGB+D" or "RGB+ED".
        pixel_centers: "half" as in gsplat, or "integer": the first pixel's centre at (0, 0).
        backend: "auto", "torch", or in float32 with tiles of 8 "numba" (on a CPU) or "triton" (on a GPU), see
            `kgs.backends`.

    Returns:
        Renders `(C, H, W, D)`, where a depth is the last channel; alphas `(C, H, W, 1)`; and a dict `meta` of the M
        pairs (camera, Gaussian) that were seen: camera_ids, gaussian_ids, depths, opacities, all `(M,)`; means2d
        `(M, 2)` in the pixels of `Ks`, which keeps its `.grad`; radii `(M, 2)`, int32, 3.33 standard deviations along
        x and y in pixels, rounded up, as gsplat's strategies expect; conics `(M, 3)`; width, height, tile_size,
        n_cameras.

    Raises:
        TypeError: an argument is not a tensor, or of another dtype or device; gsplat has no such argument.
        ValueError: shapes do not match, an option is out of range, or kgs does not support what is asked for.
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
    others |= {"radius_clip": radius_clip, "rasterize_mode": rasterize_mode, "camera_model": camera_model}
    others |= {"sparse_grad": sparse_grad, "absgrad": absgrad, "distributed": distributed}
    _check_no_ops(others)
    if not far_plane >= 1e10:
        raise ValueError(f"far_plane: expected 1e10 or more, kgs cuts nothing far away, got {far_plane}")
    if render_mode not in _MODES:
        raise ValueError(f"render_mode: expected one of {_MODES}, got {render_mode!r}")
    check_tensor("means", means)
    if backgrounds is not None:
        check_tensor("backgrounds", backgrounds)
    posed = pinhole_cameras(viewmats, Ks, width, height, pixel_centers)
    count, n = posed.batch_size, means.shape[0] if means.ndim else 0
    image = "RGB" in render_mode
    if colors is None and not image:
        colors, sh_degree = means.new_zeros(n, 0), None
    colors = _check_colors(colors, sh_degree, count, n)
    own = sh_degree is None and colors.ndim == 3
    every = colors.transpose(0, 1).flatten(1) if own else colors  # not finite in one camera: left out in all
    gaussians = Gaussians(means, quats, scales, opacities, every)
    options = RasterOptions(tile_size, near_plane, eps2d, alpha_threshold, transmittance_stop, max_bytes)
    projected = project(gaussians, posed, options=options, colors=image and not own, backend=backend)
    half = 0.5 if pixel_centers == "half" else 0.0
    means2d = projected.means2d + half
    if means2d.requires_grad:
        means2d.retain_grad()
    projected = dataclasses.replace(projected, means2d=means2d - half)
    features = projected.colors
    if image and own:
        features = colors.flatten(0, 1).index_select(0, projected.camera_ids * n + projected.gaussian_ids)
    channels = features.shape[1]
    if backgrounds is not None and image and tuple(backgrounds.shape) != (count, channels):
        raise ValueError(f"backgrounds: expected shape ({count}, {channels}), got {tuple(backgrounds.shape)}")
    if render_mode.endswith("D"):
        features = torch.cat([features, projected.depths[:, None]], 1)
    result = composite(projected, features, options=options, backend=backend)
    alphas = 1.0 - result.transmittance
    renders, depths = result.features[:, :channels], result.features[:, channels:]
    if image:
        renders = blend(renders, result.transmittance, backgrounds, "backgrounds")
    if render_mode.endswith("ED"):
        depths = depths / alphas.clamp_min(1e-10)
    names = ("camera_ids", "gaussian_ids", "depths", "conics", "opacities")
    meta = {name: getattr(projected, name) for name in names} | {"radii": _radii(projected), "means2d": means2d}
    meta |= {"width": width, "height": height, "tile_size": result.tile_size, "n_cameras": count}
    return torch.cat([renders, depths], 1).permute(0, 2, 3, 1), alphas.permute(0, 2, 3, 1), meta


def _check_no_ops(given: dict[str, Any]) -> None:
    """Raise a TypeError for an argument that gsplat does not have, a ValueError for one that is not at its no-op."""
    for name, value in given.items():
        if name in _WITHOUT_EFFECT:
            continue
        if name not in _NO_OPS:
            raise TypeError(f"rasterization: got an unexpected argument {name!r}")
        if name == "rolling_shutter" and getattr(value, "name", None) == "GLOBAL":
            continue
        if hasattr(value, "shape"):
            got = f"an array {tuple(value.shape)}"
            raise ValueError(f"{name}: expected {_NO_OPS[name]!r}, all that kgs supports, got {got}")
        if value != _NO_OPS[name]:
            raise ValueError(f"{name}: expected {_NO_OPS[name]!r}, all that kgs supports, got {value!r}")


@torch.no_grad()
def _radii(projected: ProjectedGaussians) -> Tensor:
    """Gsplat's radii, `(M, 2)` int32: 3.33 standard deviations along x and y, rounded up."""
    variances = projected.factors.square().sum(2) + projected.eps2d
    return (3.33 * variances.sqrt()).ceil().clamp_max(_LARGEST_RADIUS).int()


def _check_colors(colors: Tensor | None, sh_degree: int | None, count: int, n: int) -> Tensor:
    """The colours, of harmonics those that are used."""
    if not isinstance(colors, Tensor):
        raise TypeError(f"colors: expected a torch.Tensor, got {type(colors).__name__}")
    shape = tuple(colors.shape)
    if sh_degree is None:
        if shape[:-1] not in ((n,), (count, n)):
            raise ValueError(f"colors: expected shape ({n}, D) or ({count}, {n}, D) without sh_degree, got {shape}")
        return colors
    if not isinstance(sh_degree, int | np.integer) or sh_degree not in range(len(SH_SIZES)):
        raise ValueError(f"sh_degree: expected 0 to {len(SH_SIZES) - 1} or None, got {sh_degree}")
    least = (sh_degree + 1) ** 2
    if len(shape) != 3 or shape[0] != n or shape[1] < least or shape[2] != 3:
        raise ValueError(f"colors: expected shape ({n}, K, 3) with K >= {least} for sh_degree {sh_degree}, got {shape}")
    return colors[:, :least]
