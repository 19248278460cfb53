"""Cameras: Kornia's pinhole cameras, made and checked, and its camera models with their poses."""

from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
import torch.nn.functional as F
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.checks import check_intrinsic_rows, check_intrinsics, check_tensor
from kgs._support.errors import ArgumentError

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
            raise ArgumentError(f"extrinsics: expected shape (C, 4, 4), got {shape}")
        if not shape[0]:
            raise ArgumentError("extrinsics: expected at least one camera, got none")
        if params.ndim == 2 and params.shape[0] not in (1, shape[0]):
            raise ArgumentError(
                f"model: expected params of 1 or {shape[0]} cameras as extrinsics, got {params.shape[0]}"
            )


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
        raise ArgumentError(f"viewmats: expected shape (C, 4, 4) or (4, 4), got {tuple(viewmats.shape)}")
    poses = viewmats.reshape(-1, 4, 4)
    count = poses.shape[0]
    shape = tuple(Ks.shape)
    if shape[-2:] not in ((3, 3), (4, 4)) or shape[:-2] not in ((), (1,), (count,)):
        raise ArgumentError(f"Ks: expected shape ({count}, 3, 3), ({count}, 4, 4) or one matrix, got {shape}")
    if pixel_centers not in ("integer", "half"):
        raise ArgumentError(f'pixel_centers: expected "integer" or "half", got {pixel_centers!r}')
    for name, size in (("width", width), ("height", height)):
        if not (isinstance(size, int | np.integer) and size >= 1):
            raise ArgumentError(f"{name}: expected an integer >= 1, got {size!r}")
    traced = torch.compiler.is_compiling()  # then `project` checks
    if not traced:
        check_intrinsics("Ks", Ks)
    full = torch.eye(4, dtype=Ks.dtype, device=Ks.device).repeat(count, 1, 1)
    full[:, :2, :3] = Ks[..., :2, :3]
    full[:, :2, 2] -= 0.5 if pixel_centers == "half" else 0.0
    heights = torch.full((count,), int(height), device=poses.device)
    widths = torch.full((count,), int(width), device=poses.device)
    cameras = PinholeCamera(full, poses, heights, widths)
    if not traced:
        _remember(cameras, (int(height), int(width)))
    return cameras


def move_camera(camera: PinholeCamera, device: torch.device) -> PinholeCamera:
    """The same cameras on another device."""
    tensors = (camera.intrinsics, camera.extrinsics, camera.height, camera.width)
    return PinholeCamera(*(tensor.to(device) for tensor in tensors))


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
        raise ArgumentError(f"cameras: expected one image size (height, width), got {sorted(sizes)}")
    ((height, width),) = sizes
    if height < 1 or width < 1:
        raise ArgumentError(f"cameras: expected a positive image size, got {height}x{width}")
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
