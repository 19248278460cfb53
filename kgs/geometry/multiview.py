"""Points, depths and pixels of several cameras."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from .rigs import camera_centers


@dataclass(frozen=True, eq=False)
class ViewGeometry:
    """The matrices of V pinhole cameras, converted once for many projections; float64 on the CPU.

    Convention:
        World-to-camera extrinsics, OpenCV axes, integer pixel centres. Depth is z in the camera's frame.

    Args:
        intrinsics: `(V, 3, 3)`.
        extrinsics: `(V, 4, 4)`.
        sizes: width and height of the images in pixels, `(V, 2)`.
    """

    intrinsics: Tensor
    extrinsics: Tensor
    sizes: Tensor

    @classmethod
    def of(cls, cameras: PinholeCamera) -> Self:
        """The matrices of some cameras."""
        sizes = torch.stack([cameras.width, cameras.height], -1).double().cpu()
        return cls(cameras.intrinsics[:, :3, :3].double().cpu(), cameras.extrinsics.double().cpu(), sizes)

    @cached_property
    def inverse_intrinsics(self) -> Tensor:
        """From pixels to rays of depth 1, `(V, 3, 3)`."""
        inverse: Tensor = torch.linalg.inv(self.intrinsics)
        return inverse

    @cached_property
    def centers(self) -> Tensor:
        """The centres of the cameras in the world, `(V, 3)`."""
        return camera_centers(self.extrinsics)

    def __len__(self) -> int:
        return len(self.extrinsics)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels `(P, V, 2)` and depths `(P, V)` of P points in all cameras; pixels are invalid at depth <= 0."""
        local = torch.einsum("vij,pj->pvi", self.extrinsics[:, :3, :3], points.double()) + self.extrinsics[:, :3, 3]
        image = torch.einsum("vij,pvj->pvi", self.intrinsics, local)
        return image[..., :2] / image[..., 2:], local[..., 2]

    def unproject(self, pixels: Tensor, depths: Tensor, views: Tensor) -> Tensor:
        """World points `(P, 3)` of pixels `(P, 2)` at depths `(P,)`, each in the camera `views (P,)`."""
        rays = convert_points_to_homogeneous(pixels.double())
        local = (self.inverse_intrinsics[views] @ rays[..., None])[..., 0] * depths[:, None]
        world: Tensor = (local - self.extrinsics[views, :3, 3])[:, None] @ self.extrinsics[views, :3, :3]
        return world[:, 0]

    def relative_projection(self, view: int, other: int) -> tuple[Tensor, Tensor]:
        """H `(3, 3)` and t `(3,)`: a pixel (x, y) of `view` at depth d is at H (x, y, 1) d + t in `other`, homogeneous.

        The third of these coordinates is its depth in `other`.
        """
        turn = self.extrinsics[other, :3, :3] @ self.extrinsics[view, :3, :3].mT
        shift = self.extrinsics[other, :3, 3] - turn @ self.extrinsics[view, :3, 3]
        return self.intrinsics[other] @ turn @ self.inverse_intrinsics[view], self.intrinsics[other] @ shift

    def inside_images(self, pixels: Tensor, depths: Tensor, near: float = 0.0, far: float = math.inf) -> Tensor:
        """Whether projected points `(P, V)` lie in the images, in front of the cameras, at depths from near to far."""
        within = ((pixels > -0.5) & (pixels < self.sizes - 0.5)).all(-1)
        return within & (depths > 0) & (depths >= near) & (depths <= far)


def project_points(points: Tensor, cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    """Pixels `(P, V, 2)` and depths `(P, V)` of P points in V cameras, see :meth:`ViewGeometry.project`."""
    return ViewGeometry.of(cameras).project(points)


def unproject(pixels: Tensor, depths: Tensor, views: Tensor, cameras: PinholeCamera) -> Tensor:
    """World points `(P, 3)` of pixels of some cameras, see :meth:`ViewGeometry.unproject`."""
    return ViewGeometry.of(cameras).unproject(pixels, depths, views)


def nearest_pixels(pixels: Tensor, depths: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """The columns and rows `(P,)` of the nearest pixels, and whether they lie in the image, in front of the camera.

    Columns and rows are 0 for points outside.

    Convention:
        Integer pixel centres, rounded half to even.
    """
    rounded = pixels.round()
    inside = ((rounded >= 0) & (rounded < torch.tensor([width, height]))).all(1) & (depths > 0)
    x, y = torch.where(inside[:, None], rounded, 0.0).long().unbind(1)
    return x, y, inside


def points_in_images(points: Tensor, cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    """Depths of P points in V cameras, and whether they lie in the image, in front of the camera; both `(P, V)`."""
    geometry = ViewGeometry.of(cameras)
    pixels, depths = geometry.project(points)
    return depths, geometry.inside_images(pixels, depths)


def typical_depths(points: Tensor, cameras: PinholeCamera) -> tuple[float, float]:
    """The 1st percentile and the median of the points' depths: the scales of a scene.

    Convention:
        Depth is z in the camera's frame (OpenCV axes), in world units.

    Args:
        points: `(P, 3)`; P may be 0.
        cameras: the training cameras.

    Returns:
        Both over the depths of points inside an image, else of all points in front of a camera; 1.0 where there are
        none.
    """
    all_depths, inside = points_in_images(points.detach().cpu(), cameras)
    depths = all_depths[inside]
    if not len(depths):
        depths = all_depths[all_depths > 0]
    if not len(depths):
        return 1.0, 1.0
    near, median = np.quantile(depths, (0.01, 0.5)).tolist()  # torch.quantile refuses more than 16 million values
    return near, median
