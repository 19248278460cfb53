"""Triangulates tracks in known cameras, and keeps the points whose depth is certain.

Source: R. Hartley and A. Zisserman, Multiple View Geometry, section 12.2 (the direct linear transformation).
"""

from dataclasses import dataclass
from typing import Self

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kgs.geometry.cameras import project
from kgs.geometry.multiview import inverse_intrinsics
from kgs.geometry.rigs import camera_centers

from .tracks import Tracks

MAX_ERROR = 0.75  # pixels between a point and its observation
MIN_ANGLE = 1.0  # degrees between the two most different rays of a point


@dataclass(frozen=True, eq=False)
class TrackedPoints:
    """P points in the world with their projections into V views, and where these views see them."""

    points: Tensor  # `(P, 3)`, float64
    pixels: Tensor  # `(P, V, 2)`, the projections into all views
    depths: Tensor  # `(P, V)`, in all views
    tracks: Tracks  # the P observations

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: Tensor) -> Self:
        """Some of the points, by a mask or by indices."""
        return type(self)(self.points[rows], self.pixels[rows], self.depths[rows], self.tracks.select(rows))


def triangulate(tracks: Tracks, cameras: PinholeCamera) -> Tensor:
    """The points `(T, 3)`, float64, of tracks in two views or more; not finite or behind if rays do not meet."""
    # Unit focal lengths and an origin in the middle of the cameras keep the equations well conditioned.
    origin = camera_centers(cameras.extrinsics).mean(0)
    rotations = cameras.extrinsics[:, :3, :3]
    translations = rotations @ origin + cameras.extrinsics[:, :3, 3]
    projections = torch.cat([rotations, translations[..., None]], dim=-1)
    rays = (inverse_intrinsics(cameras) @ convert_points_to_homogeneous(tracks.pixels)[..., None])[..., 0]
    equations = (rays[..., :2, None] * projections[:, None, 2] - projections[:, :2]) * tracks.visible[..., None, None]
    null = torch.linalg.svd(equations.flatten(1, 2), full_matrices=False).Vh[:, -1]
    points: Tensor = null[:, :3] / null[:, 3:] + origin
    return points


def triangulate_certain(tracks: Tracks, cameras: PinholeCamera) -> TrackedPoints:
    """Triangulate twice, and return the points whose depth is certain.

    The first time, observations are dropped that see the point behind the camera, or `2 * MAX_ERROR` or more from its
    pixel. The second time, points are dropped that have an observation with an error of `MAX_ERROR` or more, fewer than
    two views, or no two rays with an angle of `MIN_ANGLE`.
    """
    for limit in (2.0 * MAX_ERROR, MAX_ERROR):
        points = triangulate(tracks, cameras)
        pixels, depths = project(cameras, points)
        fits = (depths > 0) & ((pixels - tracks.pixels).norm(dim=-1) < limit)
        all_fit = (fits | ~tracks.visible).all(1)
        visible = tracks.visible & fits
        enough = visible.sum(1) >= 2
        tracks = Tracks(tracks.pixels[enough], visible[enough])
    tracked = TrackedPoints(points[enough], pixels[enough], depths[enough], tracks)
    certain = all_fit[enough] & (_widest_angles(tracked, cameras) >= MIN_ANGLE)
    return tracked.select(certain)


def _widest_angles(tracked: TrackedPoints, cameras: PinholeCamera) -> Tensor:
    """The largest angle between two rays of each point in degrees, `(P,)`; 0 for a single ray."""
    rays = torch.nn.functional.normalize(tracked.points[:, None] - camera_centers(cameras.extrinsics), dim=-1)
    visible = tracked.tracks.visible
    in_both = visible[:, :, None] & visible[:, None, :]
    cosines = (rays @ rays.mT).masked_fill(~in_both, 1.0).flatten(1).amin(1)
    return cosines.clamp(-1.0, 1.0).acos().rad2deg()
