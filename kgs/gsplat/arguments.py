"""The arguments of gsplat's call as those of kgs; what kgs does not support, with the reason for each."""

from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kgs._support.checks import check_tensor
from kgs._support.errors import ArgumentError, quoted
from kgs.geometry.camera_models import camera_model
from kgs.geometry.cameras import Cameras, PosedCamera, pinhole_cameras
from kgs.geometry.covariance import covariance_factors
from kgs.geometry.types import SH_SIZES, Gaussians

_WORDS = {
    "render_mode": ("RGB", "D", "ED", "RGB+D", "RGB+ED"),
    "rasterize_mode": ("classic", "antialiased"),
    "camera_model": ("pinhole", "fisheye", "ortho"),
}
_FROM_3D = "kgs renders footprints in the image, not Gaussians in space"
_LENS = "for distorted lenses use kgs.PosedCamera and kgs.GaussianRenderer"
# The unsupported arguments: the default, which changes nothing, and the reason why others are refused.
_UNSUPPORTED: dict[str, tuple[Any, str]] = {
    "sparse_grad": (False, "the gradients of kgs are dense"),
    "distributed": (False, "kgs renders in one process"),
    "with_ut": (False, "kgs linearises the lens at each centre"),
    "with_eval3d": (False, _FROM_3D),
    "return_normals": (False, "kgs.GaussianRenderer has them as an output"),
    "global_z_order": (True, "kgs sorts by z"),
    "rays": (None, _FROM_3D),
    "radial_coeffs": (None, _LENS),
    "tangential_coeffs": (None, _LENS),
    "thin_prism_coeffs": (None, _LENS),
    "ftheta_coeffs": (None, _LENS),
    "lidar_coeffs": (None, _FROM_3D),
    "external_distortion_coeffs": (None, _LENS),
    "rolling_shutter": (None, "one pose per image"),
    "viewmats_rs": (None, "one pose per image"),
    "extra_signals": (None, "colors may have any number of channels"),
    "extra_signals_sh_degree": (None, "colors may have any number of channels"),
}


def refuse(given: dict[str, Any]) -> None:
    """Raise a ValueError for an unsupported argument that differs from its default."""
    for name, (default, why) in _UNSUPPORTED.items():
        value = given[name]
        if name == "rolling_shutter" and getattr(value, "name", None) == "GLOBAL":
            continue
        if hasattr(value, "shape"):
            raise ArgumentError(name, f"{default!r} ({why})", f"an array {tuple(value.shape)}")
        if value != default:
            raise ArgumentError(name, f"{default!r} ({why})", quoted(value))


def check_words(render_mode: str, rasterize_mode: str, camera_model: str, sh_degree: Any) -> None:
    """Raise a ValueError for a word that gsplat does not have, or that kgs does not support."""
    given = {"render_mode": render_mode, "rasterize_mode": rasterize_mode, "camera_model": camera_model}
    for name, known in _WORDS.items():
        if given[name] not in known:
            raise ArgumentError(name, f"one of {known}", quoted(given[name]))
    if camera_model == "ortho" and sh_degree:
        why = "gsplat takes directions from the centre, kgs along the rays"
        raise ArgumentError("sh_degree", f"None or 0 with camera_model 'ortho' ({why})", sh_degree)


def as_kgs(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    intrinsics: Tensor,
    *,
    size: tuple[int, int],
    lens: str,
    pixel_centers: str,
    has_image: bool,
    sh_degree: int | None,
) -> tuple[Gaussians, Cameras, Tensor | None]:
    """The Gaussians, the cameras, and features `(C, N, D)` where each camera has its own."""
    n = _length("means", means, (3,), means)
    count = _length("viewmats", viewmats, (4, 4), means)
    if not count:
        raise ArgumentError("viewmats", "at least one camera", f"shape {tuple(viewmats.shape)}")
    check = partial(_checked, like=means)
    if covars is None:
        quats = check("quats", quats, (n, 4))
        scales = check("scales", scales, (n, 3))
    else:
        upper = check("covars", covars, (n, 3, 3)).triu()  # all that gsplat reads
        quats = covariance_factors(upper + upper.triu(1).mT)
        scales = torch.ones_like(means)
    check("opacities", opacities, (n,), (count, n))
    check("Ks", intrinsics, (count, 3, 3))
    features = None
    if not has_image:
        colors = means[:, :0]
    elif sh_degree is not None:
        colors = _harmonics(colors, sh_degree, n, means)
    else:
        width = colors.shape[-1] if isinstance(colors, Tensor) and colors.ndim else 0
        colors = check("colors", colors, (n, width), (count, n, width))
        if colors.ndim == 3:
            features = colors
            colors = means[:, :0]
            finite = features.detach().isfinite().all(-1).all(0)  # `project` checks the Gaussians' colours alone
            opacities = opacities.masked_fill(~finite, torch.nan)
    gaussians = Gaussians(means, quats, scales, opacities, colors)
    return gaussians, _cameras(viewmats, intrinsics, size, lens, pixel_centers), features


def _length(name: str, value: Any, ends: tuple[int, ...], like: Any) -> int:
    """The first dimension of a tensor whose others are these: kgs takes no batch of scenes."""
    check_tensor(name, value, like if isinstance(like, Tensor) else None, " as means")
    if tuple(value.shape[1:]) != ends:
        expected = f"({'N' if name == 'means' else 'C'}, {', '.join(map(str, ends))})"
        raise ArgumentError(name, f"shape {expected}, of one scene", tuple(value.shape))
    return int(value.shape[0])


def _checked(name: str, value: Any, *shapes: tuple[int, ...], like: Tensor) -> Tensor:
    """A tensor of one of some shapes; a TypeError or ValueError for anything else."""
    check_tensor(name, value, like, " as means")
    if tuple(value.shape) not in shapes:
        raise ArgumentError(name, f"shape {' or '.join(map(str, shapes))}", tuple(value.shape))
    tensor: Tensor = value
    return tensor


def _harmonics(colors: Any, sh_degree: Any, n: int, like: Tensor) -> Tensor:
    """The harmonics that are used, `(N, K, 3)`."""
    if not isinstance(sh_degree, int | np.integer) or sh_degree not in range(len(SH_SIZES)):
        raise ArgumentError("sh_degree", f"0 to {len(SH_SIZES) - 1} or None", quoted(sh_degree))
    check_tensor("colors", colors, like, " as means")
    minimum = SH_SIZES[sh_degree]
    shape = tuple(colors.shape)
    if len(shape) != 3 or shape[0] != n or shape[1] < minimum or shape[2] != 3:
        expected = f"({n}, K, 3) with K >= {minimum} for sh_degree {sh_degree}"
        raise ArgumentError("colors", f"shape {expected}", shape)
    used: Tensor = colors[:, :minimum]
    return used


def _cameras(viewmats: Tensor, intrinsics: Tensor, size: tuple[int, int], lens: str, pixel_centers: str) -> Cameras:
    """The cameras, with integer pixel centres."""
    height, width = size
    pinholes = pinhole_cameras(viewmats, intrinsics, width, height, pixel_centers)
    if lens == "pinhole":
        return pinholes
    k = pinholes.intrinsics
    params = torch.stack([k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2]], 1)
    if lens == "ortho":
        return PosedCamera(camera_model("orthographic", params, (height, width)), viewmats)
    fisheye = torch.nn.functional.pad(params, (0, 4))
    return PosedCamera(camera_model("kannala_brandt", fisheye, (height, width)), viewmats)
