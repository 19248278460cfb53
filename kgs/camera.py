"""Kornia's cameras one by one: the pixel of a point, and its derivative.

Convention:
    World-to-camera extrinsics, OpenCV axes (x right, y down, z forward), integer pixel centres.

The derivative is closed form for pinhole and orthographic cameras and two reverse passes through Kornia's `project`
for distorted ones. Far outside the field of view the first-order footprint is meaningless and grows without bound;
as in gsplat it is taken at a point clamped to 15 % of the image size beyond its borders (perspective models without
a wide-angle mapping only). The limits are constants; the gradient follows the clamp exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.vector import Vector3
from kornia.image import ImageSize
from kornia.sensors.camera.camera_model import CameraModelBase
from kornia.sensors.camera.distortion_model import AffineTransform, BrownConradyTransform
from kornia.sensors.camera.projection_model import OrthographicProjection
from torch import Tensor

from .full_precision import in_full_precision
from .types import Cameras, PosedCamera

__all__ = ["Lens", "image_size", "intrinsics", "lenses"]

_MARGIN = 0.15


@dataclass(frozen=True)
class Lens:
    """One posed camera, reduced to what projection needs.

    Args:
        extrinsics: world-to-camera, `(4, 4)`.
        project: (world points, camera points), both `(M, 3)`, to pixels `(M, 2)`.
        jacobian: camera points `(M, 3)` to the derivative of the pixel, `(M, 2, 3)`.
        parallel: whether all rays have one direction (orthographic).
    """

    extrinsics: Tensor
    project: Callable[[Tensor, Tensor], Tensor]
    jacobian: Callable[[Tensor], Tensor]
    parallel: bool = False


def image_size(cameras: Cameras) -> tuple[int, int]:
    """Height and width in pixels, the same for all cameras.

    Raises:
        TypeError: `cameras` is neither a `PinholeCamera` nor a `PosedCamera`.
        ValueError: the cameras differ in size or have none.
    """
    if isinstance(cameras, PosedCamera):
        heights, widths = {int(cameras.model.height)}, {int(cameras.model.width)}
    elif isinstance(cameras, PinholeCamera):
        heights, widths = set(map(int, cameras.height.tolist())), set(map(int, cameras.width.tolist()))
    else:
        raise TypeError(f"cameras: expected a kornia PinholeCamera or a kgs.PosedCamera, got {type(cameras).__name__}")
    if len(heights) != 1 or len(widths) != 1:
        raise ValueError(f"cameras: expected one image size, got heights {sorted(heights)} and widths {sorted(widths)}")
    height, width = heights.pop(), widths.pop()
    if height < 1 or width < 1:
        raise ValueError(f"cameras: expected a positive image size, got {height}x{width}")
    return height, width


def intrinsics(cameras: Cameras) -> Tensor:
    """The tensor that describes the lenses: matrices, or parameters of a model."""
    return cameras.intrinsics if isinstance(cameras, PinholeCamera) else cameras.model.params


def lenses(cameras: Cameras) -> list[Lens]:
    """The cameras of a batch, one by one."""
    if isinstance(cameras, PinholeCamera):
        return [_pinhole(cameras, c) for c in range(cameras.batch_size)]
    return [_modelled(cameras, c) for c in range(cameras.extrinsics.shape[0])]


def _pinhole(cameras: PinholeCamera, c: int) -> Lens:
    one = slice(c, c + 1)
    camera = PinholeCamera(cameras.intrinsics[one], cameras.extrinsics[one], cameras.height[one], cameras.width[one])
    height, width = int(camera.height), int(camera.width)
    k = camera.intrinsics[0, :2, :2]
    fx, fy, cx, cy = (camera.intrinsics[0, i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    limits = _tangent_limits(fx, fy, cx, cy, height, width)

    def pixels(intrinsics: Tensor, extrinsics: Tensor, world: Tensor) -> Tensor:
        pixels: Tensor = PinholeCamera(intrinsics, extrinsics, camera.height, camera.width).project(world[None])[0]
        return pixels

    return Lens(
        extrinsics=camera.extrinsics[0],
        project=lambda world, _: in_full_precision(pixels, camera.intrinsics, camera.extrinsics, world),
        jacobian=lambda points: _perspective_jacobian(k, points, limits),
    )


def _modelled(cameras: PosedCamera, c: int) -> Lens:
    model = cameras.model
    params = model.params if model.params.ndim == 1 else model.params[c if model.params.shape[0] > 1 else 0]
    height, width = int(model.height), int(model.width)
    one = CameraModelBase(model.distortion, model.projection, ImageSize(height, width), params)
    fx, fy, cx, cy = params[:4].unbind()
    k = torch.diag(torch.stack([fx, fy]))
    limits = _tangent_limits(fx, fy, cx, cy, height, width)
    parallel = isinstance(model.projection, OrthographicProjection)

    def pixels(points: Tensor) -> Tensor:
        return one.project(Vector3(points)).data

    def jacobian(points: Tensor) -> Tensor:
        if parallel:
            return torch.cat([k, k.new_zeros(2, 1)], 1).expand(points.shape[0], 2, 3)
        if isinstance(model.distortion, AffineTransform):
            return _perspective_jacobian(k, points, limits)
        if isinstance(model.distortion, BrownConradyTransform):
            points = _clamp_tangents(points, limits)
        return _reverse_jacobian(pixels, points)

    return Lens(
        extrinsics=cameras.extrinsics[c],
        project=lambda _, points: pixels(points),
        jacobian=jacobian,
        parallel=parallel,
    )


def _tangent_limits(fx: Tensor, fy: Tensor, cx: Tensor, cy: Tensor, height: int, width: int) -> tuple[Tensor, ...]:
    """Lower x, upper x, lower y, upper y of x/z and y/z, without gradient."""
    fx, fy, cx, cy = fx.detach(), fy.detach(), cx.detach(), cy.detach()
    mx, my = _MARGIN * width, _MARGIN * height
    return (
        -(cx + 0.5 + mx) / fx,
        (width - 0.5 - cx + mx) / fx,
        -(cy + 0.5 + my) / fy,
        (height - 0.5 - cy + my) / fy,
    )


def _clamp_tangents(points: Tensor, limits: tuple[Tensor, ...]) -> Tensor:
    x, y, z = points.unbind(1)
    return torch.stack([(x / z).clamp(limits[0], limits[1]) * z, (y / z).clamp(limits[2], limits[3]) * z, z], 1)


def _perspective_jacobian(k: Tensor, points: Tensor, limits: tuple[Tensor, ...]) -> Tensor:
    """K [1/z 0 -x/z^2; 0 1/z -y/z^2] with x/z, y/z clamped, for K's whole 2x2 block."""
    x, y, z = points.unbind(1)
    inverse = 1.0 / z
    tx = (x * inverse).clamp(limits[0], limits[1])
    ty = (y * inverse).clamp(limits[2], limits[3])
    last = -inverse[:, None] * in_full_precision(torch.matmul, torch.stack([tx, ty], 1), k.T)
    return torch.cat([inverse[:, None, None] * k, last[:, :, None]], 2)


def _reverse_jacobian(pixels: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    differentiable = torch.is_grad_enabled() and pixels(points[:1]).requires_grad
    with torch.inference_mode(False), torch.enable_grad():
        if not (differentiable and points.requires_grad):
            points = points.detach().clone().requires_grad_()
        uv = pixels(points)
        rows = [
            torch.autograd.grad(uv[:, i].sum(), points, create_graph=differentiable, retain_graph=True)[0]
            for i in (0, 1)
        ]
    jacobian = torch.stack(rows, 1)
    return jacobian if differentiable else jacobian.detach()
