"""Points from tracks: linear triangulation from any number of views, and the filters that keep what is certain.

Source: R. Hartley and A. Zisserman, Multiple View Geometry, section 12.2 (the direct linear transformation).
"""

from __future__ import annotations

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from .tracks import Tracks

__all__ = ["camera_centers", "project_all", "triangulate", "triangulate_certain", "unproject"]


def triangulate(tracks: Tracks, cameras: PinholeCamera) -> Tensor:
    """Find the points that the tracks see: the null vectors of their projection equations.

    Convention:
        World-to-camera extrinsics, OpenCV axes, integer pixel centres.

    Args:
        tracks: T tracks in V views, each seen by at least two.
        cameras: the V cameras.

    Returns:
        Points `(T, 3)` in float64. They are not finite, or behind cameras, where the rays do not meet.
    """
    intrinsics, extrinsics = _matrices(cameras)
    # Unit focal lengths and an origin amid the cameras keep the equations well conditioned.
    origin = camera_centers(cameras).mean(0)
    rotations, translations = extrinsics[:, :3, :3], extrinsics[:, :3, :3] @ origin + extrinsics[:, :3, 3]
    projections = torch.cat([rotations, translations[..., None]], dim=-1)
    rays = (torch.linalg.inv(intrinsics) @ convert_points_to_homogeneous(tracks.pixels)[..., None])[..., 0]
    equations = rays[..., :2, None] * projections[:, None, 2] - projections[:, :2]
    equations = (equations * tracks.seen[..., None, None]).flatten(1, 2)
    null = torch.linalg.svd(equations, full_matrices=False).Vh[:, -1]
    points: Tensor = null[:, :3] / null[:, 3:] + origin
    return points


def triangulate_certain(
    tracks: Tracks, cameras: PinholeCamera, max_error: float = 0.75, min_angle: float = 1.0
) -> tuple[Tensor, Tracks]:
    """Triangulate, leave out what contradicts it, and keep the points whose depth is certain.

    An observation goes if its camera has the point behind it or twice `max_error` or more away from its pixel; the
    points are then found once more without these, and a point that has an observation `max_error` or more away goes,
    as does one that fewer than two views are left to see.

    Args:
        tracks: T tracks in V views.
        cameras: the V cameras.
        max_error: the largest reprojection error, in pixels.
        min_angle: the least angle between the two most different rays of a point, in degrees.

    Returns:
        Points `(P, 3)` in float64 and their tracks, P <= T.
    """
    for limit in (2.0 * max_error, max_error):
        points = triangulate(tracks, cameras)
        pixels, depths = project_all(points, cameras)
        fits = (depths > 0) & ((pixels - tracks.pixels).norm(dim=-1) < limit)
        agreeing = (fits | ~tracks.seen).all(1)
        kept = tracks.seen & fits
        enough = kept.sum(1) >= 2
        points, agreeing = points[enough], agreeing[enough]
        tracks = Tracks(tracks.pixels[enough], kept[enough])
    certain = agreeing & (_widest_angles(points, tracks.seen, cameras) >= min_angle)
    return points[certain], tracks.select(certain)


def project_all(points: Tensor, cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    """Pixels `(P, V, 2)` and depths `(P, V)` of P points in V cameras, float64; pixels mean nothing at depth <= 0."""
    intrinsics, extrinsics = _matrices(cameras)
    local = torch.einsum("vij,pj->pvi", extrinsics[:, :3, :3], points.double()) + extrinsics[:, :3, 3]
    image = torch.einsum("vij,pvj->pvi", intrinsics, local)
    return image[..., :2] / image[..., 2:], local[..., 2]


def unproject(pixels: Tensor, depths: Tensor, views: Tensor, cameras: PinholeCamera) -> Tensor:
    """The places in the world `(P, 3)` of pixels `(P, 2)` at depths `(P,)`, each in the camera of its view, float64."""
    intrinsics, extrinsics = _matrices(cameras)
    rays = torch.cat([pixels.double(), torch.ones_like(depths)[:, None]], dim=1)
    local = (torch.linalg.inv(intrinsics)[views] @ rays[..., None])[..., 0] * depths[:, None]
    world: Tensor = (local - extrinsics[views, :3, 3])[:, None] @ extrinsics[views, :3, :3]
    return world[:, 0]


def camera_centers(cameras: PinholeCamera) -> Tensor:
    """The centres of V cameras in the world, `(V, 3)` in float64."""
    _, extrinsics = _matrices(cameras)
    return -(extrinsics[:, :3, :3].mT @ extrinsics[:, :3, 3:])[..., 0]


def _widest_angles(points: Tensor, seen: Tensor, cameras: PinholeCamera) -> Tensor:
    rays = torch.nn.functional.normalize(points[:, None] - camera_centers(cameras), dim=-1)
    both = seen[:, :, None] & seen[:, None, :]
    cosines = (rays @ rays.mT).masked_fill(~both, 1.0).flatten(1).amin(1)
    return cosines.clamp(-1.0, 1.0).acos().rad2deg()


def _matrices(cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    return cameras.intrinsics[:, :3, :3].double().cpu(), cameras.extrinsics.double().cpu()
