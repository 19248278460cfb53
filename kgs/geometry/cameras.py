"""Kornia's pinhole cameras: made, selected, moved, resized, turned, projected with; and its lens models with poses.

`kgs.cameras` has the public names. A `PinholeCamera` can be neither indexed nor moved to a device: only this file makes
one, and changes one by making another.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, SupportsIndex
from weakref import WeakKeyDictionary

import numpy as np
import torch
import torch.nn.functional as F
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.checks import check_intrinsic_rows, check_intrinsics, check_tensor
from kgs._support.errors import ArgumentError, quoted

from .camera_models import CameraModel


@dataclass(frozen=True, eq=False)
class PosedCamera:
    """One of Kornia's camera models together with its poses: for lenses that `PinholeCamera` cannot describe.

    Its tensors are not cloned, so the next render sees what an optimiser has changed in them.

    Convention:
        OpenCV axes (x right, y down, z forward), pixels with integer centres.

    Args:
        model: a `kornia.sensors.camera.CameraModel` of any of its four types, from points in the camera frame to
            pixels; its `params` are `(P,)`, shared by all poses, or `(C, P)`, one row per pose.
        extrinsics: world-to-camera, `(C, 4, 4)`.

    Raises:
        TypeError: `model` is not a Kornia camera model or `extrinsics` not a tensor.
        ValueError: shapes do not match.
    """

    model: CameraModel
    extrinsics: Tensor

    def __post_init__(self) -> None:
        if not hasattr(self.model, "project") or not hasattr(self.model, "params"):
            raise TypeError(f"model: expected a kornia.sensors.camera.CameraModel, got {type(self.model).__name__}")
        check_tensor("extrinsics", self.extrinsics)
        shape = tuple(self.extrinsics.shape)
        params = self.model.params
        if len(shape) != 3 or shape[1:] != (4, 4):
            raise ArgumentError("extrinsics", "shape (C, 4, 4)", shape)
        if not shape[0]:
            raise ArgumentError("extrinsics", "at least one camera", "none")
        if params.ndim == 2 and params.shape[0] not in (1, shape[0]):
            raise ArgumentError("model", f"params of 1 or {shape[0]} cameras as extrinsics", params.shape[0])


Cameras = PinholeCamera | PosedCamera


def pinhole_cameras(
    viewmats: Tensor, Ks: Tensor, width: int, height: int, pixel_centers: str = "integer"
) -> PinholeCamera:
    """Kornia's pinhole cameras from matrices and integer sizes; differentiable.

    A `PinholeCamera` clones its arguments. If you optimise poses or intrinsics, create a new one in each step.

    Convention:
        World-to-camera matrices, OpenCV axes. The result has integer pixel centres, whatever those of `Ks`.

    Args:
        viewmats: world-to-camera matrices, OpenCV axes, `(C, 4, 4)`, or `(4, 4)` for one.
        Ks: intrinsics in pixels, `(C, 3, 3)` or `(C, 4, 4)`, or one matrix for all cameras. The third row is (0, 0, 1):
            a constant, without gradient.
        width: of the images in pixels, an integer >= 1.
        height: likewise.
        pixel_centers: where the first pixel's centre lies in the coordinates of `Ks`: "integer" at (0, 0) as in Kornia
            and OpenCV, "half" at (0.5, 0.5) as in COLMAP and gsplat.

    Raises:
        TypeError: an argument is not a tensor, or dtypes or devices differ.
        ValueError: shapes or sizes do not match, or the third row of a matrix in `Ks` is not (0, 0, 1).

    Examples:
        >>> import torch, kgs
        >>> k = torch.tensor([[20.0, 0.0, 16.0], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]])
        >>> kgs.pinhole_cameras(torch.eye(4), k, width=32, height=24, pixel_centers="half").cx
        tensor([15.5000])
    """
    check_tensor("viewmats", viewmats)
    check_tensor("Ks", Ks, viewmats, " as viewmats")
    if viewmats.ndim not in (2, 3) or viewmats.shape[-2:] != (4, 4):
        raise ArgumentError("viewmats", "shape (C, 4, 4) or (4, 4)", tuple(viewmats.shape))
    poses = viewmats.reshape(-1, 4, 4)
    count = poses.shape[0]
    shape = tuple(Ks.shape)
    if shape[-2:] not in ((3, 3), (4, 4)) or shape[:-2] not in ((), (1,), (count,)):
        raise ArgumentError("Ks", f"shape ({count}, 3, 3), ({count}, 4, 4) or one matrix", shape)
    if pixel_centers not in ("integer", "half"):
        raise ArgumentError("pixel_centers", '"integer" or "half"', quoted(pixel_centers))
    for name, side in (("width", width), ("height", height)):
        if not (isinstance(side, int | np.integer) and side >= 1):
            raise ArgumentError(name, "an integer >= 1", quoted(side))
    traced = torch.compiler.is_compiling()  # then `project` checks
    if not traced:
        check_intrinsics("Ks", Ks)
    full = torch.eye(4, dtype=Ks.dtype, device=Ks.device).repeat(count, 1, 1)
    full[:, :2, :3] = Ks[..., :2, :3]
    full[:, :2, 2] -= 0.5 if pixel_centers == "half" else 0.0
    size = int(height), int(width)
    cameras = _with_size(full, poses, size)
    if not traced:
        _remember(cameras, size)
    return cameras


def select(cameras: PinholeCamera, index: SupportsIndex | Sequence[SupportsIndex] | slice | Tensor) -> PinholeCamera:
    """Some of the cameras as a batch: one, those at several positions, or those of a slice.

    Args:
        cameras: C cameras.
        index: an integer, integers (a tensor of them on any device), or a slice.

    Raises:
        TypeError: positions are not integers.
        IndexError: there is no such camera.
    """
    count = len(cameras.extrinsics)
    if isinstance(index, slice):
        index = range(count)[index]
    rows = index if isinstance(index, Tensor) else torch.as_tensor(index, device="cpu")
    if rows.numel() and (rows.is_floating_point() or rows.is_complex() or rows.dtype == torch.bool):
        raise TypeError(f"index: expected integers, got {rows.dtype}")
    rows = rows.reshape(-1).long()
    if not bool(((rows >= -count) & (rows < count)).all()):
        raise IndexError(f"index: expected whole numbers below {count}, the number of cameras, got {rows.tolist()}")
    rows = rows.to(cameras.extrinsics.device)
    return PinholeCamera(*(values[rows] for values in _tensors(cameras)))


def joined(*parts: PinholeCamera) -> PinholeCamera:
    """The cameras of several batches in one, in this order."""
    return PinholeCamera(*map(torch.cat, zip(*map(_tensors, parts), strict=True)))


def to(
    cameras: PinholeCamera, device: torch.device | str | None = None, dtype: torch.dtype | None = None
) -> PinholeCamera:
    """The cameras on another device, or with matrices of another dtype; None leaves either as it is."""
    intrinsics, extrinsics = (x.to(device=device, dtype=dtype) for x in (cameras.intrinsics, cameras.extrinsics))
    return PinholeCamera(intrinsics, extrinsics, cameras.height.to(device=device), cameras.width.to(device=device))


def posed(cameras: PinholeCamera, extrinsics: Tensor) -> PinholeCamera:
    """The same lenses at other poses: world-to-camera `(C, 4, 4)`, OpenCV axes."""
    return PinholeCamera(cameras.intrinsics, extrinsics, cameras.height, cameras.width)


def resized(
    cameras: PinholeCamera,
    scale: float | tuple[float, float],
    size: tuple[int, int],
    corner: tuple[float, float] = (0.0, 0.0),
) -> PinholeCamera:
    """The cameras of images that are scaled, and then cut to one size; differentiable.

    Convention:
        Integer pixel centres: a principal point c moves to (c + 1/2) s - 1/2, less the corner.

    Args:
        cameras: C cameras.
        scale: the factor of the images' width and height, or one of each.
        size: height and width of the result in pixels.
        corner: where its first pixel lies in the scaled image, (x, y) in pixels.
    """
    scales = scale if isinstance(scale, tuple) else (scale, scale)
    matrices = cameras.intrinsics.clone()
    for axis, (factor, first) in enumerate(zip(scales, corner, strict=True)):
        matrices[:, axis, :3] *= factor
        matrices[:, axis, 2] += (factor - 1) / 2 - first
    return _with_size(matrices, cameras.extrinsics, size)


def turned(cameras: PinholeCamera, quarters: int = 1) -> PinholeCamera:
    """The cameras of images that are turned clockwise by quarter turns; they see the same; differentiable.

    Convention:
        Integer pixel centres: a pixel (x, y) of an image of height H moves to (H - 1 - y, x). The camera's x axis is up
        before, its y axis to the right.

    Args:
        cameras: C cameras, of any sizes.
        quarters: how many, counterclockwise where negative.
    """
    height = cameras.height
    width = cameras.width
    matrices = cameras.intrinsics
    poses = cameras.extrinsics
    signs = matrices.new_tensor([[1.0, -1.0], [-1.0, 1.0]])
    for _ in range(quarters % 4):
        before = matrices
        matrices = before.clone()
        matrices[:, :2, :2] = before[:, :2, :2].flip(1, 2) * signs
        matrices[:, 0, 2] = height.to(before) - 1 - before[:, 1, 2]
        matrices[:, 1, 2] = before[:, 0, 2]
        poses = torch.cat([-poses[:, 1:2], poses[:, :1], poses[:, 2:]], 1)
        height, width = width, height
    return PinholeCamera(matrices, poses, height, width)


def project(cameras: PinholeCamera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels and depths of P points in C cameras, exactly: float64 on the CPU, whatever the cameras are.

    Convention:
        Integer pixel centres; depth is z in the camera's frame (OpenCV axes), in world units.

    Args:
        cameras: C cameras, of any sizes.
        points: in world coordinates, `(P, 3)`.

    Returns:
        Pixels (x, y), `(P, C, 2)`, which mean nothing at a depth <= 0, and depths, `(P, C)`.
    """
    poses = cameras.extrinsics.double().cpu()
    matrices = cameras.intrinsics[:, :3, :3].double().cpu().contiguous()
    local = torch.einsum("vij,pj->pvi", poses[:, :3, :3], points.double().cpu()) + poses[:, :3, 3]
    image = torch.einsum("vij,pvj->pvi", matrices, local)
    return image[..., :2] / image[..., 2:], local[..., 2]


def _with_size(intrinsics: Tensor, extrinsics: Tensor, size: tuple[int, int]) -> PinholeCamera:
    """Cameras from `(C, 4, 4)` matrices and one (height, width) for all of them."""
    sizes = (torch.full((len(extrinsics),), side, device=extrinsics.device) for side in size)
    return PinholeCamera(intrinsics, extrinsics, *sizes)


def _tensors(cameras: PinholeCamera) -> tuple[Tensor, ...]:
    return cameras.intrinsics, cameras.extrinsics, cameras.height, cameras.width


class _CheckedSize(NamedTuple):
    """The size of a pinhole camera whose tensors have been read and checked."""

    tensors: tuple[Tensor, ...]  # held, so that no other tensor gets their ids
    versions: list[tuple[int, int]]
    size: tuple[int, int]


_checked_sizes: WeakKeyDictionary[PinholeCamera, _CheckedSize] = WeakKeyDictionary()


def image_size(cameras: Cameras) -> tuple[int, int]:
    """Height and width in pixels, the same for all cameras; checks what `cameras` is, and the intrinsics' last rows.

    Reading the tensors of a camera on a GPU waits until all work is done, so it is done again only when they change.
    """
    if not isinstance(cameras, PinholeCamera):
        return _model_size(cameras)
    if not len(cameras.extrinsics):
        raise ArgumentError("cameras", "at least one camera", "none")
    checked = _checked_sizes.get(cameras)
    if checked is not None and checked.versions == _versions(cameras):
        return checked.size
    size = _pinhole_size(cameras)
    _remember(cameras, size)
    return size


def _remember(cameras: PinholeCamera, size: tuple[int, int]) -> None:
    """Cache the size of cameras whose tensors have been checked."""
    versions = _versions(cameras)
    if versions is not None:
        _checked_sizes[cameras] = _CheckedSize(_checked_tensors(cameras), versions, size)


def _checked_tensors(cameras: PinholeCamera) -> tuple[Tensor, ...]:
    return cameras.height, cameras.width, cameras.intrinsics


def _versions(cameras: PinholeCamera) -> list[tuple[int, int]] | None:
    """The ids and versions of a camera's tensors; None for tensors of inference mode, which have no version."""
    tensors = _checked_tensors(cameras)
    if any(x.is_inference() for x in tensors):
        return None
    return [(id(x), x._version) for x in tensors]


def _pinhole_size(cameras: PinholeCamera) -> tuple[int, int]:
    matrices = cameras.intrinsics.detach().double()
    last = F.pad(torch.stack([cameras.height, cameras.width], 1).to(matrices), (0, matrices.shape[-1] - 2))
    rows = torch.cat([matrices, last[:, None]], 1).tolist()  # at once: a GPU waits each time
    check_intrinsic_rows("cameras", [matrix[:-1] for matrix in rows])
    return _one_size({(int(matrix[-1][0]), int(matrix[-1][1])) for matrix in rows})


def _model_size(cameras: PosedCamera) -> tuple[int, int]:
    if not isinstance(cameras, PosedCamera):
        raise TypeError(f"cameras: expected a kornia PinholeCamera or a kgs.PosedCamera, got {type(cameras).__name__}")
    return _one_size({(int(cameras.model.height), int(cameras.model.width))})


def _one_size(sizes: set[tuple[int, int]]) -> tuple[int, int]:
    """The only (height, width) of some; a ValueError if there are others, or it is not positive."""
    if len(sizes) != 1:
        raise ArgumentError("cameras", "one image size (height, width)", sorted(sizes))
    ((height, width),) = sizes
    if height < 1 or width < 1:
        raise ArgumentError("cameras", "a positive image size", f"{height}x{width}")
    return height, width


def with_constant_last_rows(cameras: Cameras) -> Cameras:
    """The same cameras, without gradient in the last rows of the intrinsics: these are constants, see `image_size`."""
    if not isinstance(cameras, PinholeCamera) or not cameras.intrinsics.requires_grad:
        return cameras
    matrices = torch.cat([cameras.intrinsics[:, :2], cameras.intrinsics[:, 2:].detach()], 1)
    return PinholeCamera(matrices, cameras.extrinsics, cameras.height, cameras.width)


def intrinsics(cameras: Cameras) -> Tensor:
    """The tensor that describes the lenses: matrices, or parameters of a model."""
    return cameras.intrinsics if isinstance(cameras, PinholeCamera) else cameras.model.params
