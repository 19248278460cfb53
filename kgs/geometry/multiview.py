"""Points, depths and pixels of several cameras."""

import math

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from .cameras import project


def unproject(cameras: PinholeCamera, pixels: Tensor, depths: Tensor, views: Tensor) -> Tensor:
    """World points `(P, 3)` float64 of pixels `(P, 2)` at depths `(P,)`, each in the camera `views (P,)`."""
    rays = convert_points_to_homogeneous(pixels.double())
    local = (inverse_intrinsics(cameras)[views] @ rays[..., None])[..., 0] * depths[:, None]
    poses = cameras.extrinsics.double().cpu()
    world: Tensor = (local - poses[views, :3, 3])[:, None] @ poses[views, :3, :3]
    return world[:, 0]


def inverse_intrinsics(cameras: PinholeCamera) -> Tensor:
    """From pixels to rays of depth 1, `(C, 3, 3)` float64 on the CPU."""
    inverse: Tensor = torch.linalg.inv(cameras.intrinsics[:, :3, :3].double().cpu())
    return inverse


def relative_projection(cameras: PinholeCamera, view: int, other: int) -> tuple[Tensor, Tensor]:
    """H `(3, 3)` and t `(3,)`: a pixel (x, y) of `view` at depth d is at H (x, y, 1) d + t in `other`, homogeneous.

    The third of these coordinates is its depth in `other`. Float64 on the CPU.
    """
    pose, there = cameras.extrinsics[[view, other]].double().cpu()
    k, k_there = cameras.intrinsics[[view, other], :3, :3].double().cpu()
    turn = there[:3, :3] @ pose[:3, :3].mT
    shift = there[:3, 3] - turn @ pose[:3, 3]
    return k_there @ turn @ torch.linalg.inv(k), k_there @ shift


def inside_images(
    cameras: PinholeCamera, pixels: Tensor, depths: Tensor, near: float = 0.0, far: float = math.inf
) -> Tensor:
    """Whether projected points lie in the images, in front of the cameras, at depths from near to far, `(P, C)`."""
    sizes = torch.stack([cameras.width, cameras.height], -1).double().cpu()
    within = ((pixels > -0.5) & (pixels < sizes - 0.5)).all(-1)
    return within & (depths > 0) & (depths >= near) & (depths <= far)


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
    pixels, depths = project(cameras, points)
    return depths, inside_images(cameras, pixels, depths)


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
    all_depths, inside = points_in_images(points.detach(), cameras)
    depths = all_depths[inside]
    if not len(depths):
        depths = all_depths[all_depths > 0]
    if not len(depths):
        return 1.0, 1.0
    near, median = np.quantile(depths, (0.01, 0.5)).tolist()  # torch.quantile refuses more than 16 million values
    return near, median
