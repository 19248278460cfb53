"""Between which depths a scene lies: from SIFT points of the training views, else from the cameras."""

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.progress import ProgressBar, silent
from kgs.datasets.scene import Views
from kgs.geometry.multiview import inside_images
from kgs.geometry.rigs import camera_centers, meeting_point
from kgs.geometry.spacing import log_spacing

from .tracks import find_tracks
from .triangulate import TrackedPoints, triangulate_certain

MIN_SIFT = 20  # a fit from fewer SIFT points is worse than one from random points
MAX_SPACING = 4.0  # a point is isolated if its distance to its neighbours is larger than this times the median


def certain_points(
    views: Views, cameras: PinholeCamera, bar: ProgressBar = silent, backend: str = "auto"
) -> TrackedPoints:
    """The triangulated SIFT points of typical depths; if these are at least `MIN_SIFT`, without isolated ones."""
    tracked = triangulate_certain(find_tracks(views, bar, backend), cameras)
    tracked = tracked.select(_within_typical_depths(tracked))
    return tracked.select(_has_neighbours(tracked, cameras)) if len(tracked) >= MIN_SIFT else tracked


def depth_range(tracked: TrackedPoints, cameras: PinholeCamera) -> tuple[float, float]:
    """The expected range of depths: from those of the points if they are at least two, else from the cameras."""
    if len(tracked) > 1:
        minimum, maximum = np.quantile(tracked.depths[tracked.depths > 0], (0.01, 0.99)).tolist()
        return 0.8 * minimum, 1.25 * maximum
    centers = camera_centers(cameras.extrinsics)
    meeting = meeting_point(cameras.extrinsics)
    if meeting is not None:
        axes = cameras.extrinsics[:, 2, :3]
        to_meeting = ((meeting - centers) * axes).sum(1)
        return 0.3 * float(to_meeting.min()), 2.0 * float(to_meeting.max())
    baseline = float(torch.cdist(centers, centers).max()) or 1.0
    return baseline, 20.0 * baseline


def sweep_range(tracked: TrackedPoints, cameras: PinholeCamera) -> tuple[float, float]:
    """The depths of the plane sweep: wider than those of all points, since cutting off the background costs quality."""
    if len(tracked) < MIN_SIFT:
        return depth_range(tracked, cameras)
    inside = tracked.depths[inside_images(cameras, tracked.pixels, tracked.depths)]
    return 0.85 * float(inside.min()), 1.3 * float(inside.max())


def _within_typical_depths(tracked: TrackedPoints) -> Tensor:
    """Whether the depths of a point lie, in all its views, between half the 1st and twice the 99th percentile."""
    depths = tracked.depths
    visible = tracked.tracks.visible
    if not visible.any():
        return torch.zeros(len(tracked), dtype=torch.bool)
    minimum, maximum = np.quantile(
        depths[visible], (0.01, 0.99)
    ).tolist()  # torch.quantile takes up to 16 million values
    typical: Tensor = ((depths > 0.5 * minimum) & (depths < 2.0 * maximum)) | ~visible
    return typical.all(1)


def _has_neighbours(tracked: TrackedPoints, cameras: PinholeCamera) -> Tensor:
    """Whether a point has others near it. Isolated points would get a huge scale, and are usually false matches."""
    focal = cameras.intrinsics[:, 0, 0]
    pixels_per_unit = (focal / tracked.depths).masked_fill(~tracked.tracks.visible, 0.0).amax(1)
    spacing = log_spacing(tracked.points).exp() * pixels_per_unit
    return spacing < MAX_SPACING * spacing.median()
