"""The scenes of a batch: gsplat's tensors, of any leading dimensions, as Gaussians, cameras and features."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType
from torch import Tensor

from kgs.camera import Cameras, PosedCamera, pinhole_cameras
from kgs.covariance import half_axes
from kgs.types import SH_SIZES, Gaussians, ProjectedGaussians, check_tensor


@dataclass(frozen=True, eq=False)
class Scene:
    """N Gaussians, C cameras, and what each camera sees in colours of its own."""

    gaussians: Gaussians  # their colours are harmonics, or the features that all cameras share, side by side
    cameras: Cameras
    shared: dict[str, int]  # which these are, and how wide, or {"image": 3}
    own: dict[str, Tensor]  # one set per camera, (C, N, D)

    def features_of(self, projected: ProjectedGaussians) -> dict[str, Tensor]:
        """Image and extra signals of what is drawn, `(M, D)` each."""
        found = dict(zip(self.shared, projected.colors.split(list(self.shared.values()), 1), strict=True))
        places = projected.camera_ids * len(self.gaussians) + projected.gaussian_ids
        own = {name: values.flatten(0, 1).index_select(0, places) for name, values in self.own.items()}
        return {name: (found | own)[name] for name in ("image", "extra") if name in found or name in own}


def batch_shape(means: Any, viewmats: Any) -> tuple[tuple[int, ...], int, int]:
    """The leading dimensions, how many cameras a scene has, and how many Gaussians."""
    for name, value, ends in (("means", means, (3,)), ("viewmats", viewmats, (4, 4))):
        check_tensor(name, value)
        if value.ndim <= len(ends) or tuple(value.shape[-len(ends) :]) != ends:
            kind = "(..., N, 3)" if name == "means" else "(..., C, 4, 4)"
            raise ValueError(f"{name}: expected shape {kind}, got {tuple(value.shape)}")
    batch = tuple(means.shape[:-2])
    if not math.prod(batch):
        raise ValueError(f"means: expected at least one scene, got shape {tuple(means.shape)}")
    if tuple(viewmats.shape[:-3]) != batch:
        raise ValueError(f"viewmats: expected shape {(*batch, 'C', 4, 4)}, got {tuple(viewmats.shape)}")
    return batch, viewmats.shape[-3], means.shape[-2]


def split(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    extra_signals: Tensor | None,
    sh_degree: int | None,
    viewmats: Tensor,
    intrinsics: Tensor,
    size: tuple[int, int],
    lens: str,
    pixel_centers: str,
) -> list[Scene]:
    """The scenes, one after the other; see `kgs.rasterization` for the arguments."""
    batch, count, n = batch_shape(means, viewmats)
    if covars is None:
        quats, scales = _flat("quats", quats, batch, (n, 4)), _flat("scales", scales, batch, (n, 3))
    else:
        flat = _flat("covars", covars, batch, (n, 3, 3))
        quats, scales = half_axes(flat.flatten(0, 1)).view_as(flat), torch.ones_like(flat[..., 0])
    opacities = _flat("opacities", opacities, batch, (n,), (count, n))
    intrinsics = _flat("Ks", intrinsics, batch, (count, 3, 3))
    harmonics = _harmonics(colors, sh_degree, batch, n)
    plain = {}
    if harmonics is None and colors is not None:
        plain["image"] = _features("colors", colors, batch, count, n)
    if extra_signals is not None:
        plain["extra"] = _features("extra_signals", extra_signals, batch, count, n)
        if harmonics is not None and plain["extra"].ndim == 3:  # harmonics are all that the cameras can share
            plain["extra"] = plain["extra"][:, None].expand(-1, count, -1, -1)
    shared = {name: x.shape[-1] for name, x in plain.items() if x.ndim == 3}
    means, viewmats = means.reshape(-1, n, 3), viewmats.reshape(-1, count, 4, 4)
    scenes = []
    for b in range(math.prod(batch)):
        own = {name: x[b] for name, x in plain.items() if x.ndim == 4}
        if harmonics is None:
            drawn = torch.cat([means.new_zeros(n, 0), *(plain[name][b] for name in shared)], 1)
        else:
            drawn, shared = harmonics[b if len(harmonics) > 1 else 0], {"image": 3}
        gaussians = Gaussians(means[b], quats[b], scales[b], _drop_broken(opacities[b], own), drawn)
        cameras = _cameras(viewmats[b], intrinsics[b], size, lens, pixel_centers)
        scenes.append(Scene(gaussians, cameras, shared, own))
    return scenes


def _flat(name: str, value: Any, batch: tuple[int, ...], *shapes: tuple[int, ...]) -> Tensor:
    """A tensor of the shape `(*batch, *shape)` for one of some shapes, with one leading dimension for the batch."""
    check_tensor(name, value)
    for shape in shapes:
        if tuple(value.shape) == batch + shape:
            flat: Tensor = value.reshape(-1, *shape) if math.prod(value.shape) else value.new_empty(1, *shape)
            return flat
    expected = " or ".join(str(batch + shape) for shape in shapes)
    raise ValueError(f"{name}: expected shape {expected}, got {tuple(value.shape)}")


def _features(name: str, value: Any, batch: tuple[int, ...], count: int, n: int) -> Tensor:
    check_tensor(name, value)
    width = value.shape[-1] if value.ndim else 0
    return _flat(name, value, batch, (n, width), (count, n, width))


def _harmonics(colors: Any, sh_degree: int | None, batch: tuple[int, ...], n: int) -> Tensor | None:
    """The harmonics that are used, `(1, N, K, 3)` where all scenes share them, or `(B, N, K, 3)`."""
    if sh_degree is None:
        return None
    if not isinstance(sh_degree, int | np.integer) or sh_degree not in range(len(SH_SIZES)):
        raise ValueError(f"sh_degree: expected 0 to {len(SH_SIZES) - 1} or None, got {sh_degree}")
    check_tensor("colors", colors)
    least, shape = SH_SIZES[sh_degree], tuple(colors.shape)
    if shape[:-2] not in ((n,), (*batch, n)) or shape[-2] < least or shape[-1] != 3:
        expected = f"({n}, K, 3) with K >= {least} for sh_degree {sh_degree}"
        raise ValueError(f"colors: expected shape {expected}, got {shape}")
    used: Tensor = colors[..., :least, :].reshape(-1, n, least, 3) if n else colors.new_empty(1, 0, least, 3)
    return used


def _drop_broken(opacities: Tensor, own: dict[str, Tensor]) -> Tensor:
    """The opacities, NaN for Gaussians with a feature of a camera that is not finite: none sees them."""
    for values in own.values():
        opacities = opacities.masked_fill(~values.detach().isfinite().all(-1).all(0), torch.nan)
    return opacities


def _cameras(viewmats: Tensor, intrinsics: Tensor, size: tuple[int, int], lens: str, pixel_centers: str) -> Cameras:
    """The cameras of a scene, with integer pixel centres."""
    height, width = size
    pinholes = pinhole_cameras(viewmats, intrinsics, width, height, pixel_centers)
    if lens == "pinhole":
        return pinholes
    k = pinholes.intrinsics
    params = torch.stack([k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2]], 1)
    kind = CameraModelType.ORTHOGRAPHIC
    if lens == "fisheye":
        kind, params = CameraModelType.KANNALA_BRANDT_K3, torch.nn.functional.pad(params, (0, 4))
    return PosedCamera(CameraModel(ImageSize(height, width), kind, params), viewmats)
