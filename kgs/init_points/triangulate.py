"""Triangulates tracks in known cameras, and keeps the points whose depth is certain.

Source: R. Hartley and A. Zisserman, Multiple View Geometry, section 12.2 (the direct linear transformation).
"""

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kgs.geometry import camera_centers, camera_matrices, project_points

from .tracks import Tracks

MAX_ERROR = 0.75  # pixels between a point and its observation
MIN_ANGLE = 1.0  # degrees between the two most different rays of a point


def triangulate(tracks: Tracks, cameras: PinholeCamera) -> Tensor:
    """The points `(T, 3)`, float64, of tracks in two views or more; not finite or behind if rays do not meet."""
    intrinsics, extrinsics = camera_matrices(cameras)
    # Unit focal lengths and an origin in the middle of the cameras keep the equations well conditioned.
    origin = camera_centers(cameras.extrinsics).mean(0)
    rotations, translations = extrinsics[:, :3, :3], extrinsics[:, :3, :3] @ origin + extrinsics[:, :3, 3]
    projections = torch.cat([rotations, translations[..., None]], dim=-1)
    rays = (torch.linalg.inv(intrinsics) @ convert_points_to_homogeneous(tracks.pixels)[..., None])[..., 0]
    equations = (rays[..., :2, None] * projections[:, None, 2] - projections[:, :2]) * tracks.seen[..., None, None]
    null = torch.linalg.svd(equations.flatten(1, 2), full_matrices=False).Vh[:, -1]
    points: Tensor = null[:, :3] / null[:, 3:] + origin
    return points


def triangulate_certain(tracks: Tracks, cameras: PinholeCamera) -> tuple[Tensor, Tracks]:
    """Triangulate twice, and keep the points whose depth is certain, with their tracks.

    The first time, observations are dropped that see the point behind the camera, or `2 * MAX_ERROR` or more from its
    pixel. The second time, points are dropped that have an observation with an error of `MAX_ERROR` or more, fewer than
    two views, or no two rays with an angle of `MIN_ANGLE`.
    """
    for limit in (2.0 * MAX_ERROR, MAX_ERROR):
        points = triangulate(tracks, cameras)
        pixels, depths = project_points(points, cameras)
        fits = (depths > 0) & ((pixels - tracks.pixels).norm(dim=-1) < limit)
        agreeing = (fits | ~tracks.seen).all(1)
        kept = tracks.seen & fits
        enough = kept.sum(1) >= 2
        points, agreeing = points[enough], agreeing[enough]
        tracks = Tracks(tracks.pixels[enough], kept[enough])
    rays = torch.nn.functional.normalize(points[:, None] - camera_centers(cameras.extrinsics), dim=-1)
    cosines = (rays @ rays.mT).masked_fill(~(tracks.seen[:, :, None] & tracks.seen[:, None, :]), 1.0).flatten(1).amin(1)
    certain = agreeing & (cosines.clamp(-1.0, 1.0).acos().rad2deg() >= MIN_ANGLE)
    return points[certain], tracks.select(certain)
