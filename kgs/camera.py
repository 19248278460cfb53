"""Camera models: each of Kornia's cameras as a projection of points to pixels, and its derivative.

The derivative is closed form for pinhole and orthographic cameras and two reverse passes through Kornia's `project`
for distorted ones. Far outside the field of view the first-order footprint is meaningless and grows without bound;
as in gsplat, it is therefore evaluated at a point clamped to 15 % of the image size beyond its borders (perspective
models without a wide-angle mapping only). The gradient follows the clamp exactly, that of the lens its limits too.

A distorted lens sees only up to the angle where the radius in the image stops growing: what lies beyond this fold of
the radial polynomial is not rendered.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
import torch.nn.functional as F
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_from_homogeneous
from kornia.geometry.vector import Vector3
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel
from kornia.sensors.camera.camera_model import CameraModelBase
from kornia.sensors.camera.distortion_model import AffineTransform, BrownConradyTransform
from kornia.sensors.camera.projection_model import OrthographicProjection
from numpy.polynomial import Polynomial
from torch import Tensor

from kgs._support.errors import ArgumentError, quoted

from .types import check_intrinsic_rows, check_intrinsics, check_tensor

MARGIN = 0.15
Pixels = Callable[[Tensor], Tensor]
Frame = tuple[float, float, float, float]  # left, top, right and bottom, in pixels


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


@dataclass(frozen=True, eq=False)
class Lens:
    """One posed camera, reduced to what projection needs."""

    extrinsics: Tensor  # world-to-camera, (4, 4)
    project: Callable[[Tensor], Tensor]  # camera points (M, 3) to pixels (M, 2)
    jacobian: Callable[[Tensor], Tensor]  # camera points to the derivative of the pixel, (M, 2, 3)
    parallel: bool = False  # whether all rays have one direction (orthographic)
    in_view: Callable[[Tensor], Tensor] | None = None  # whether camera points lie before the fold, (M,); None: all do


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
    for name, size in (("width", width), ("height", height)):
        if not (isinstance(size, int | np.integer) and size >= 1):
            raise ArgumentError(name, "an integer >= 1", quoted(size))
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


def times(matrix: Tensor, vectors: Tensor) -> Tensor:
    """The product of a matrix `(I, J)` with each of some vectors, `(*, J)` to `(*, I)`.

    Computed elementwise: torch rounds matrix products to bfloat16 or TF32 under `torch.autocast` or
    `torch.set_float32_matmul_precision`, which would leave 8 bits of a pixel coordinate.
    """
    return (vectors[..., None, :] * matrix).sum(-1)


def lenses(cameras: Cameras, size: tuple[int, int] | None = None, frame: Frame | None = None) -> list[Lens]:
    """The cameras of a batch, one by one.

    `size` is (height, width) of their images if it is known, `frame` that of :class:`kgs.RasterOptions`.
    """
    frame = frame or whole_frame(size or image_size(cameras))
    if isinstance(cameras, PinholeCamera):
        return [_pinhole(cameras, c, frame) for c in range(cameras.batch_size)]
    return [_modelled(cameras, c, frame) for c in range(cameras.extrinsics.shape[0])]


def _pinhole(cameras: PinholeCamera, c: int, frame: Frame) -> Lens:
    """Camera c of some pinhole cameras."""
    matrix = _for_autograd(cameras.intrinsics)[c]
    pose = _for_autograd(cameras.extrinsics)[c]
    limits = tangent_limits(matrix.diagonal()[:2], matrix[:2, 2], frame)

    def pixels(points: Tensor) -> Tensor:
        projected: Tensor = convert_points_from_homogeneous(times(matrix[:3, :3], points))
        return projected

    def jacobian(points: Tensor) -> Tensor:
        return _perspective_jacobian(matrix[:2, :2], points, limits)

    return Lens(pose, pixels, jacobian)


def _modelled(cameras: PosedCamera, c: int, frame: Frame) -> Lens:
    """Camera c of a posed camera model."""
    model = cameras.model
    params = _for_autograd(model.params)
    pose = _for_autograd(cameras.extrinsics)[c]
    if params.ndim == 2:
        params = params[c if params.shape[0] > 1 else 0]
    size = ImageSize(int(model.height), int(model.width))
    one = CameraModelBase(model.distortion, model.projection, size, params)
    k = torch.diag(params[:2])
    limits = tangent_limits(params[:2], params[2:4], frame)
    parallel = isinstance(model.projection, OrthographicProjection)
    plain = parallel or isinstance(model.distortion, AffineTransform)
    brown_conrady = isinstance(model.distortion, BrownConradyTransform)

    def pixels(points: Tensor) -> Tensor:
        return one.project(Vector3(points)).data

    def jacobian(points: Tensor) -> Tensor:
        if parallel:
            return torch.cat([k, k.new_zeros(2, 1)], 1).expand(points.shape[0], 2, 3)
        if plain:
            return _perspective_jacobian(k, points, limits)
        if brown_conrady:
            z = points[:, 2]
            x = _clamp_keeping_gradient(points[:, 0] / z, *limits[0]) * z
            y = _clamp_keeping_gradient(points[:, 1] / z, *limits[1]) * z
            points = torch.stack([x, y, z], 1)
        return _reverse_jacobian(pixels, points)

    in_view = None if plain else _before_fold(params.tolist(), brown_conrady)
    return Lens(pose, pixels, jacobian, parallel, in_view)


def _for_autograd(tensor: Tensor) -> Tensor:
    """The tensor, or a clone of one made in inference mode, which autograd would refuse."""
    with torch.inference_mode(False):
        return tensor.clone() if tensor.is_inference() else tensor


def _before_fold(params: list[float], brown_conrady: bool) -> Callable[[Tensor], Tensor] | None:
    """Whether points lie at a smaller angle than the fold, where the radius in the image stops growing; None: all do.

    The radius is r P(r^2) / Q(r^2) of the tangent r (Brown-Conrady), or t P(t^2) of the angle t (Kannala-Brandt). Its
    derivative has the sign of the polynomial (P + 2 s P') Q - 2 s P Q' in s, the square of r or t.
    """
    if brown_conrady:
        k1, k2, _, _, k3, k4, k5, k6 = params[4:]
        p = Polynomial([1.0, k1, k2, k3])
        q = Polynomial([1.0, k4, k5, k6])
    else:
        p = Polynomial([1.0, *params[4:]])
        q = Polynomial([1.0])
    s = Polynomial([0.0, 1.0])
    growth = (p + 2 * s * p.deriv()) * q - 2 * s * p * q.deriv()
    if not np.isfinite(growth.coef).all():
        return None
    roots = np.concatenate([growth.trim().roots(), q.trim().roots()])
    fold = min((float(x.real) for x in roots if x.imag == 0 and x.real > 0), default=math.inf)
    if brown_conrady:
        if fold == math.inf:
            return None
        return lambda points: points[:, :2].square().sum(1) < fold * points[:, 2].square()
    angle = math.sqrt(fold)
    if angle >= math.pi / 2:
        return None
    return lambda points: points[:, :2].norm(dim=1) < math.tan(angle) * points[:, 2]


def whole_frame(size: tuple[int, int]) -> Frame:
    """The borders of an image of (height, width) pixels, whose first pixel has its centre at (0, 0)."""
    return -0.5, -0.5, size[1] - 0.5, size[0] - 0.5


def tangent_limits(focal: Tensor, centre: Tensor, frame: Frame) -> Tensor:
    """Limits of x/z and y/z as rows (lower, upper), `(2, 2)`; focal lengths may be negative."""
    begin, end = focal.new_tensor([frame[:2], frame[2:]])
    margin = MARGIN * (end - begin)
    first = -(centre - begin + margin) / focal
    last = (end - centre + margin) / focal
    return torch.stack([torch.minimum(first, last), torch.maximum(first, last)], 1)


def _perspective_jacobian(k: Tensor, points: Tensor, limits: Tensor) -> Tensor:
    """K [1/z 0 -x/z^2; 0 1/z -y/z^2] with x/z, y/z clamped, for K's whole 2x2 block."""
    inverse = 1.0 / points[:, 2]
    x = _clamp_keeping_gradient(points[:, 0] * inverse, *limits[0])
    y = _clamp_keeping_gradient(points[:, 1] * inverse, *limits[1])
    last = -inverse[:, None] * times(k, torch.stack([x, y], 1))
    return torch.cat([inverse[:, None, None] * k, last[:, :, None]], 2)


def _clamp_keeping_gradient(x: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """`x.clamp(low, high)` with the gradient of `x` at the limits too, as before torch 2.14."""
    return x.masked_fill(x < low, low).masked_fill(x > high, high)


def _reverse_jacobian(pixels: Pixels, points: Tensor) -> Tensor:
    """The derivative of the pixels by reverse passes; differentiable once more where `pixels` is."""
    differentiable = torch.is_grad_enabled() and pixels(points[:1]).requires_grad
    with torch.inference_mode(False), torch.enable_grad():
        if not (differentiable and points.requires_grad):
            points = points.detach().clone().requires_grad_()
        options: Any = {"create_graph": differentiable, "retain_graph": True}
        rows = [torch.autograd.grad(part.sum(), points, **options)[0] for part in pixels(points).unbind(1)]
    jacobian = torch.stack(rows, 1)
    return jacobian if differentiable else jacobian.detach()
