"""Points, pixels and poses: projection of points, positions of cameras, spacing of points."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kgs._support.errors import ArgumentError

from .types import check_tensor

NEIGHBOURS = 3
MIN_RELATIVE_SPACING = 1e-3
_MAX_DISTANCES = 2**24  # at a time


def camera_centers(extrinsics: Tensor) -> Tensor:
    """The centres of cameras in the world, `(C, 3)` float64 on the CPU, from world-to-camera matrices `(C, 4, 4)`."""
    poses = extrinsics.detach().double().cpu()
    return -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]


def camera_extent(extrinsics: Tensor) -> float:
    """Size of a camera rig: 1.1 times the largest distance of a camera's centre to the mean of the centres.

    Source: the normalisation of NeRF++ (Zhang et al., 2020) as 3D Gaussian Splatting uses it; over training cameras.

    Convention:
        World-to-camera extrinsics; the direction of the axes does not matter.

    Args:
        extrinsics: matrices [R | t] with a rotation R, `(C, 4, 4)`, C >= 1, else a ValueError.

    Returns:
        The extent in world units; 0 for a single camera.
    """
    check_tensor("extrinsics", extrinsics)
    if extrinsics.ndim != 3 or extrinsics.shape[-2:] != (4, 4) or len(extrinsics) == 0:
        raise ArgumentError("extrinsics", "shape (C, 4, 4) with C >= 1", tuple(extrinsics.shape))
    centres = camera_centers(extrinsics)
    return 1.1 * float((centres - centres.mean(dim=0)).norm(dim=1).max())


def common_up(extrinsics: Tensor) -> Tensor:
    """The mean up direction of cameras `(C, 4, 4)`, `(3,)` float64 of length 1; the first one's where they disagree."""
    ups = -extrinsics[:, 1, :3].detach().double().cpu()
    mean = ups.mean(dim=0)
    up = mean if mean.norm() > 0.1 else ups[0]
    unit: Tensor = up / up.norm()
    return unit


def meeting_point(extrinsics: Tensor) -> Tensor | None:
    """The point nearest to all optical axes, `(3,)` float64; None where axes are near-parallel, or it is behind one.

    Convention:
        World-to-camera extrinsics, OpenCV axes, `(V, 4, 4)`. Axes within about 5 degrees count as parallel.
    """
    poses = torch.linalg.inv(extrinsics.double().cpu())
    centers = poses[:, :3, 3]
    axes = poses[:, :3, 2]
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    if torch.linalg.eigvalsh(across.mean(0))[0] <= 0.005:
        return None
    meeting = torch.linalg.solve(across.sum(0), (across @ centers[..., None]).sum(0)[:, 0])
    in_front = (((meeting - centers) * axes).sum(1) > 0).all()
    return meeting if bool(in_front) else None


def degrees_between(rotations: Tensor, others: Tensor) -> Tensor:
    """The angles by which rotations `(..., 3, 3)` differ, `(...)`; |R - S| is 2 sqrt(2) times the sine of its half."""
    sines: Tensor = torch.linalg.matrix_norm(rotations - others) / 8**0.5
    return 2 * sines.clamp(max=1).asin().rad2deg()


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


def log_spacing(points: Tensor) -> Tensor:
    """Logarithm of the root mean squared distance to the three nearest points, float64 `(N,)`.

    The initial scale of Gaussians. It is at least a thousandth of the cloud's median spacing, because points may
    coincide. Where points coincide in groups of four or more and more than half of the distinct points occur three or
    more times (the triangles of an STL), distances are those between distinct points.

    Args:
        points: `(N, 3)`, N >= 4, finite, not all in one place; else a ValueError.
    """
    if len(points) <= NEIGHBOURS:
        raise ArgumentError("points", f"at least {NEIGHBOURS + 1} to take a spacing from", len(points))
    points = points.double()
    centred = points - points.mean(dim=0)
    size = centred.abs().amax()
    if not 0.0 < float(size) < math.inf:
        raise ArgumentError("points", "points in different places", f"a cloud of half size {float(size):g}")
    centred = centred / size  # float32 then suffices to find the neighbours, whatever the cloud's unit and position
    centred = centred.masked_fill(centred.abs() < 1e-100, 0.0)  # its square would be 0
    squared = _mean_squared_distance(centred)
    if not bool(squared.all()):
        distinct, inverse, counts = centred.unique(dim=0, return_inverse=True, return_counts=True)
        if 2 * int((counts >= NEIGHBOURS).sum()) > len(distinct):
            squared = _mean_squared_distance(distinct).index_select(0, inverse)
    typical = squared[squared > 0].median()
    return 0.5 * squared.clamp(min=MIN_RELATIVE_SPACING**2 * typical).log() + size.log()


def _mean_squared_distance(points: Tensor) -> Tensor:
    """The mean squared distance to the nearest three points, or to all others where they are fewer, `(N,)`."""
    ids = _nearest(points, min(NEIGHBOURS + 1, len(points)))[:, 1:]  # the first is the point itself or its double
    return (points[ids] - points[:, None, :]).square().sum(dim=-1).mean(dim=-1)


def _nearest(points: Tensor, count: int) -> Tensor:
    """The nearest points of each point in float32, in order, `(N, count)`; without OpenCV in quadratic time."""
    data = points.float().cpu()
    try:
        import cv2
    except ModuleNotFoundError:
        blocks = data.split(max(1, _MAX_DISTANCES // len(data)))
        exact = "donot_use_mm_for_euclid_dist"
        found = [torch.cdist(x, data, compute_mode=exact).topk(count, largest=False).indices for x in blocks]
        return torch.cat(found).to(points.device)
    array = data.numpy()  # the index refers to this array, it makes no copy
    index = cv2.flann_Index(array, {"algorithm": 4})  # type: ignore[attr-defined]  # an exact k-d tree; not in the stubs
    nearest, _ = index.knnSearch(array, count, params={})
    return torch.from_numpy(nearest).long().to(points.device)
