"""From points in the world to pixels and depths of views, and back; and the depths that a scene has."""

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kgs.datasets.scene import Views

# Quantiles are NumPy's: torch.quantile refuses more than 16 million values.


def project_all(points: Tensor, cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    """Pixels `(P, V, 2)` and depths `(P, V)` of P points in V cameras, float64; pixels mean nothing at depth <= 0."""
    intrinsics, extrinsics = matrices(cameras)
    local = torch.einsum("vij,pj->pvi", extrinsics[:, :3, :3], points.double()) + extrinsics[:, :3, 3]
    image = torch.einsum("vij,pvj->pvi", intrinsics, local)
    return image[..., :2] / image[..., 2:], local[..., 2]


def picture_places(pixels: Tensor, depths: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Whole pixels x and y `(P,)` of a picture, and whether they are in it, before the camera; x and y are 0 outside.

    Convention:
        Integer pixel centres, rounded half to even.
    """
    places = pixels.round()
    inside = ((places >= 0) & (places < torch.tensor([width, height]))).all(1) & (depths > 0)
    x, y = torch.where(inside[:, None], places, 0.0).long().unbind(1)
    return x, y, inside


def unproject(pixels: Tensor, depths: Tensor, views: Tensor, cameras: PinholeCamera) -> Tensor:
    """The places in the world `(P, 3)` of pixels `(P, 2)` at depths `(P,)`, each in the camera of its view, float64."""
    intrinsics, extrinsics = matrices(cameras)
    rays = convert_points_to_homogeneous(pixels.double())
    local = (torch.linalg.inv(intrinsics)[views] @ rays[..., None])[..., 0] * depths[:, None]
    world: Tensor = (local - extrinsics[views, :3, 3])[:, None] @ extrinsics[views, :3, :3]
    return world[:, 0]


def matrices(cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    """Intrinsics `(V, 3, 3)` and world-to-camera extrinsics `(V, 4, 4)` in float64 on the CPU."""
    return cameras.intrinsics[:, :3, :3].double().cpu(), cameras.extrinsics.double().cpu()


def in_views(pixels: Tensor, depths: Tensor, views: Views, near: float, far: float) -> Tensor:
    """Whether points `(P, V)` lie in the images of the views, between two depths."""
    limits = torch.tensor([views.images.shape[-1] - 0.5, views.images.shape[-2] - 0.5], dtype=pixels.dtype)
    return ((pixels > -0.5) & (pixels < limits)).all(-1) & (depths >= near) & (depths <= far)


def seen_depths(points: Tensor, views: Views) -> Tensor:
    """Depths of points in the views whose image they lie in, `(D,)`."""
    pixels, depths = project_all(points, views.cameras)
    return depths[in_views(pixels, depths, views, 0.0, torch.inf) & (depths > 0)]


def typical_depths(views: Views, points: Tensor) -> tuple[float, float]:
    """The 1st percentile and the median of the points' depths: the scales of a scene.

    Convention:
        Depth is z in the camera's frame (OpenCV axes), in world units.

    Args:
        views: the training views.
        points: `(P, 3)`; P may be 0.

    Returns:
        Both over the depths of points inside an image, else of all points before a camera; 1.0 where there are none.
    """
    points = points.detach().cpu()
    depths = seen_depths(points, views)
    if not len(depths):
        _, depths = project_all(points, views.cameras)
        depths = depths[depths > 0]
    near, median = np.quantile(depths, (0.01, 0.5)).tolist() if len(depths) else (1.0, 1.0)
    return near, median
