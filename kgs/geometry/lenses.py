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
from typing import Any

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_from_homogeneous
from numpy.polynomial import Polynomial
from torch import Tensor

from . import camera_models
from .cameras import Cameras, PosedCamera, image_size

MARGIN = 0.15
Pixels = Callable[[Tensor], Tensor]
Frame = tuple[float, float, float, float]  # left, top, right and bottom, in pixels


@dataclass(frozen=True, eq=False)
class Lens:
    """One posed camera, reduced to what projection needs."""

    extrinsics: Tensor  # world-to-camera, (4, 4)
    project: Callable[[Tensor], Tensor]  # camera points (M, 3) to pixels (M, 2)
    jacobian: Callable[[Tensor], Tensor]  # camera points to the derivative of the pixel, (M, 2, 3)
    parallel: bool = False  # whether all rays have one direction (orthographic)
    in_view: Callable[[Tensor], Tensor] | None = None  # whether camera points lie before the fold, (M,); None: all do


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
    k = torch.diag(params[:2])
    limits = tangent_limits(params[:2], params[2:4], frame)
    lens = camera_models.lens_of(model)

    def pixels(points: Tensor) -> Tensor:
        return camera_models.project(model, params, points)

    def jacobian(points: Tensor) -> Tensor:
        if lens == "orthographic":
            return torch.cat([k, k.new_zeros(2, 1)], 1).expand(points.shape[0], 2, 3)
        if lens == "pinhole":
            return _perspective_jacobian(k, points, limits)
        if lens == "brown_conrady":
            z = points[:, 2]
            x = _clamp_keeping_gradient(points[:, 0] / z, *limits[0]) * z
            y = _clamp_keeping_gradient(points[:, 1] / z, *limits[1]) * z
            points = torch.stack([x, y, z], 1)
        return _reverse_jacobian(pixels, points)

    if lens in ("orthographic", "pinhole"):
        return Lens(pose, pixels, jacobian, parallel=lens == "orthographic")
    return Lens(pose, pixels, jacobian, in_view=_before_fold(params.tolist(), lens == "brown_conrady"))


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
