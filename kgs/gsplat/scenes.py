"""The scenes of a batch: gsplat's tensors, of any leading dimensions, as Gaussians, cameras and features."""

import math
from collections.abc import Callable
from dataclasses import dataclass
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
from kgs.geometry.harmonics import evaluate_harmonics
from kgs.geometry.projection import view_directions
from kgs.geometry.types import SH_SIZES, Gaussians, ProjectedGaussians


@dataclass(frozen=True, eq=False)
class Scene:
    """N Gaussians, C cameras, and the features to render beside the Gaussians' colours."""

    gaussians: Gaussians  # their colours are harmonics, or the features that all cameras share, side by side
    cameras: Cameras
    widths: dict[str, int]  # names and widths of the features in the Gaussians' colours, {"image": 3} for harmonics
    others: dict[str, Tensor]  # other features, (N, D), or one set per camera (C, N, D)
    harmonics: Tensor | None = (
        None  # (N, K, 3), of orthographic cameras: gsplat evaluates them from the cameras' centres
    )

    def features_of(self, projected: ProjectedGaussians) -> dict[str, Tensor]:
        """Image and extra signals of the projected Gaussians, `(M, D)` each."""
        features = dict(zip(self.widths, projected.colors.split(list(self.widths.values()), 1), strict=True))
        if self.harmonics is not None:
            features["image"] = self._evaluate_from_centres(self.harmonics, projected)
        for name, values in self.others.items():
            rows = projected.gaussian_ids
            if values.ndim == 3:
                rows = projected.camera_ids * len(self.gaussians) + rows
                values = values.flatten(0, 1)
            features[name] = values.index_select(0, rows)
        return {name: features[name] for name in ("image", "extra") if name in features}

    def _evaluate_from_centres(self, harmonics: Tensor, projected: ProjectedGaussians) -> Tensor:
        """Colours `(M, 3)` by the directions from the cameras' centres, although rays are parallel."""
        ids = projected.gaussian_ids
        directions = []
        for c, pose in enumerate(self.cameras.extrinsics):
            means = self.gaussians.means.index_select(0, ids[projected.camera_ids == c])
            directions.append(view_directions(means, pose))
        return evaluate_harmonics(harmonics.index_select(0, ids), torch.cat(directions))


def batch_shape(means: Any, viewmats: Any) -> tuple[tuple[int, ...], int, int]:
    """The leading dimensions, and the numbers of cameras and of Gaussians of a scene."""
    for name, value, ends in (("means", means, (3,)), ("viewmats", viewmats, (4, 4))):
        check_tensor(name, value, means if isinstance(means, Tensor) else None, " as means")
        if value.ndim <= len(ends) or tuple(value.shape[-len(ends) :]) != ends:
            kind = "(..., N, 3)" if name == "means" else "(..., C, 4, 4)"
            raise ArgumentError(name, f"shape {kind}", tuple(value.shape))
    batch = tuple(means.shape[:-2])
    if not math.prod(batch):
        raise ArgumentError("means", "at least one scene", f"shape {tuple(means.shape)}")
    if not viewmats.shape[-3]:
        raise ArgumentError("viewmats", "at least one camera", f"shape {tuple(viewmats.shape)}")
    if tuple(viewmats.shape[:-3]) != batch:
        raise ArgumentError("viewmats", f"shape {(*batch, 'C', 4, 4)}", tuple(viewmats.shape))
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
    shape: tuple[tuple[int, ...], int, int],
) -> list[Scene]:
    """The scenes, one after the other; see `kgs.rasterization` for the arguments, `batch_shape` for the last."""
    batch, count, n = shape
    flat = partial(_flat, batch=batch, like=means)
    if covars is None:
        quats = flat("quats", quats, (n, 4))
        scales = flat("scales", scales, (n, 3))
    else:
        upper = flat("covars", covars, (n, 3, 3)).triu()  # all that gsplat reads
        whole = upper + upper.triu(1).mT
        quats = covariance_factors(whole.flatten(0, 1)).view_as(whole)
        scales = torch.ones_like(whole[..., 0])
    opacities = flat("opacities", opacities, (n,), (count, n))
    intrinsics = flat("Ks", intrinsics, (count, 3, 3))
    harmonics = _harmonics(colors, sh_degree, batch, n, means)
    features = {}
    if colors is not None and harmonics is None:
        features["image"] = _flat_features("colors", colors, flat, n, count)
    if extra_signals is not None:
        features["extra"] = _flat_features("extra_signals", extra_signals, flat, n, count)
    means = flat("means", means, (n, 3))
    viewmats = flat("viewmats", viewmats, (count, 4, 4))
    # features that all cameras share become the Gaussians' colours, unless these are harmonics
    shared = [name for name, x in features.items() if x.ndim == 3 and harmonics is None]
    scenes = []
    for b in range(math.prod(batch)):
        others = {name: x[b] for name, x in features.items() if name not in shared}
        bands = None if harmonics is None else harmonics[b if len(harmonics) > 1 else 0]
        bands_from_centres = None
        if lens == "ortho":  # gsplat evaluates harmonics from the centre; kgs along the rays, which are parallel
            bands_from_centres = bands
            bands = None
        if bands is None:
            gaussian_colors = torch.cat([means[b, :, :0], *(features[name][b] for name in shared)], 1)
            widths = {name: features[name].shape[-1] for name in shared}
        else:
            gaussian_colors = bands
            widths = {"image": 3}
        unchecked = list(others.values())  # `project` checks the Gaussians' colours alone
        if bands_from_centres is not None:
            unchecked.append(bands_from_centres.flatten(1))
        gaussians = Gaussians(means[b], quats[b], scales[b], _drop_broken(opacities[b], unchecked), gaussian_colors)
        cameras = _cameras(viewmats[b], intrinsics[b], size, lens, pixel_centers)
        scenes.append(Scene(gaussians, cameras, widths, others, bands_from_centres))
    return scenes


def _flat_features(name: str, value: Any, flat: Callable[..., Tensor], n: int, count: int) -> Tensor:
    """Features `(B, N, D)`, or one set per camera `(B, C, N, D)`, of any width D."""
    width = value.shape[-1] if isinstance(value, Tensor) and value.ndim else 0
    return flat(name, value, (n, width), (count, n, width))


def _flat(name: str, value: Any, *shapes: tuple[int, ...], batch: tuple[int, ...], like: Tensor) -> Tensor:
    """A tensor of the shape `(*batch, *shape)` for one of some shapes, with one leading dimension for the batch."""
    check_tensor(name, value, like, " as means")
    for shape in shapes:
        if tuple(value.shape) == batch + shape:
            flat: Tensor = value.reshape(math.prod(batch), *shape)
            return flat
    expected = " or ".join(str(batch + shape) for shape in shapes)
    raise ArgumentError(name, f"shape {expected}", tuple(value.shape))


def _harmonics(colors: Any, sh_degree: int | None, batch: tuple[int, ...], n: int, like: Tensor) -> Tensor | None:
    """The harmonics that are used, `(1, N, K, 3)` where all scenes share them, or `(B, N, K, 3)`."""
    if sh_degree is None:
        return None
    if not isinstance(sh_degree, int | np.integer) or sh_degree not in range(len(SH_SIZES)):
        raise ArgumentError("sh_degree", f"0 to {len(SH_SIZES) - 1} or None", quoted(sh_degree))
    check_tensor("colors", colors, like, " as means")
    minimum = SH_SIZES[sh_degree]
    shape = tuple(colors.shape)
    if shape[:-2] not in ((n,), (*batch, n)) or shape[-2] < minimum or shape[-1] != 3:
        shapes = " or ".join(dict.fromkeys(str((*part, n, "K", 3)) for part in ((), batch)))
        expected = f"{shapes} with K >= {minimum} for sh_degree {sh_degree}"
        raise ArgumentError("colors", f"shape {expected}", shape)
    used: Tensor = colors[..., :minimum, :].reshape(math.prod(shape[:-3]), n, minimum, 3)
    return used


def _drop_broken(opacities: Tensor, features: list[Tensor]) -> Tensor:
    """The opacities, NaN for Gaussians with a feature that is not finite: these are not rendered."""
    for values in features:
        finite = values.detach().isfinite().all(-1)
        opacities = opacities.masked_fill(~(finite if values.ndim == 2 else finite.all(0)), torch.nan)
    return opacities


def _cameras(viewmats: Tensor, intrinsics: Tensor, size: tuple[int, int], lens: str, pixel_centers: str) -> Cameras:
    """The cameras of a scene, with integer pixel centres."""
    height, width = size
    pinholes = pinhole_cameras(viewmats, intrinsics, width, height, pixel_centers)
    if lens == "pinhole":
        return pinholes
    k = pinholes.intrinsics
    params = torch.stack([k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2]], 1)
    if lens == "ortho":
        return PosedCamera(camera_model("orthographic", params, size), viewmats)
    return PosedCamera(camera_model("kannala_brandt", torch.nn.functional.pad(params, (0, 4)), size), viewmats)
