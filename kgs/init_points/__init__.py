"""Makes the initial points of a fit, from the training views only: test views are never used here."""

import warnings
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.geometry import (
    camera_centers,
    depths_in_images,
    inside_images,
    log_spacing,
    meeting_point,
    project_points,
    unproject,
)
from kgs.progress import Stage, silent
from kgs.types import check_kind

from .dense import FEWEST, dense_points
from .files import read_points
from .tracks import find_tracks
from .triangulate import triangulate_certain

__all__ = ["InitialPoints", "initial_points"]

KINDS, DRAWS = ("dense", "sift", "random", "file"), ("uniform", "spread")
MIN_DENSE = 1000
MIN_SIFT = 20  # a fit from fewer SIFT points is worse than one from random points
MAX_SPACING = 4.0  # of a point to its neighbours, in medians over all points; beyond that it is isolated


@dataclass(frozen=True)
class InitialPoints:
    """The points that a fit starts from, with their colours.

    Args:
        points: in the frame of the views, `(P, 3)` float32 on the CPU.
        colors: RGB in [0, 1], `(P, 3)` float32.
        kind: where the points come from: "dense", "sift", "random", "file", or the scene's `init_kind`.
    """

    points: Tensor
    colors: Tensor
    kind: str


def initial_points(
    views: Views,
    kind: str = "dense",
    *,
    seed: int = 0,
    count: int | None = 10_000,
    pixels: int | None = None,
    file: str | PathLike[str] | None = None,
    origin: Tensor | None = None,
    stage: Stage = silent,
    backend: str = "auto",
    draw: str = "uniform",
) -> InitialPoints:
    """Find the points that a fit starts from.

    Convention:
        Points in the frame of the views' cameras, OpenCV axes, world units.

    Args:
        views: the training views, and only these.
        kind: "dense": points of depth maps that at least two views agree on, drawn at random; if they are fewer than
            1000, "sift" with a warning. "sift": SIFT keypoints of the images, matched and triangulated with the given
            poses; if they are fewer than 20, "random" with a warning. "random": spread evenly over the space that at
            least two of the views see (one, if there is only one), in the images' mean colours there, at the depths of
            the SIFT points or else where the cameras look. "file": the points of a 3DGS PLY file, or of a cloud or
            mesh that trimesh reads, up to 1 GiB.
        seed: of the random draws.
        count: how many points "random" gives, and "dense" at most; >= 1. None: of "dense" one for every 3 pixels with
            an agreed depth, 30 000 at least and 60 000 at most; of "random" 30 000.
        pixels: how many pixels all images of the fit have, for a count of None; those of `views` unless given.
        file: the file of the kind "file".
        origin: subtracted from the points of the file, `(3,)`: the `offset` of the scene, if the file has its world
            coordinates.
        stage: shows the progress: :func:`kgs.app.console.each`, or nothing.
        backend: one of :func:`kgs.backends.available`, for "dense" and "sift".
        draw: how "dense" points are drawn: "uniform", or "spread" evenly over the images.

    Returns:
        The points. `kind` says what they are: "random" if "sift" was asked for and found too few.

    Raises:
        TypeError: `views` is not a `Views`; a whole scene, for instance.
        ValueError: another kind or draw, `count` below 1, or no file for "file".
        DataError: the file is missing, broken, compressed, too large, or has no points.
    """
    check_kind("views", views, Views)
    if kind not in KINDS:
        raise ValueError(f"kind: expected one of {list(KINDS)}, got {kind!r}")
    if draw not in DRAWS:
        raise ValueError(f"draw: expected one of {list(DRAWS)}, got {draw!r}")
    if count is not None and count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    if kind == "file":
        if file is None:
            raise ValueError("file: expected a path for the kind 'file', got None")
        return InitialPoints(*read_points(Path(file), origin), kind)
    points, tracks = triangulate_certain(find_tracks(views, stage, backend), views.cameras)
    good = _within_typical_depths(points, tracks.seen, views.cameras)
    points, tracks = points[good], tracks.select(good)
    if len(points) >= MIN_SIFT:
        good = _has_neighbours(points, tracks.seen, views.cameras)
        points, tracks = points[good], tracks.select(good)
    near, far = _depth_range(points, views.cameras)
    generator = torch.Generator().manual_seed(seed)
    if kind == "dense":
        near, far = _sweep_range(points, views) if len(points) >= MIN_SIFT else (near, far)
        dense, colors, agreed = dense_points(views, near, far, count, generator, stage, backend, draw, pixels)
        if agreed >= (MIN_DENSE if count is None else min(MIN_DENSE, count)):
            return InitialPoints(dense, colors, kind)
        message = f"initial points: {len(views)} training views agree on {agreed} points only; SIFT points instead"
        warnings.warn(message, stacklevel=2)
    count = FEWEST if count is None else count
    if kind in ("dense", "sift"):
        if len(points) >= MIN_SIFT:
            return InitialPoints(points.float(), _mean_colors(views, tracks.pixels, tracks.seen), "sift")
        message = f"initial points: SIFT found {len(points)} in {len(views)} training views, fewer than {MIN_SIFT}; "
        warnings.warn(f"{message}the fit starts from {count} random points instead", stacklevel=2)
    points = _random_points(views, count, near, far, generator)
    places, depths = project_points(points, views.cameras)
    seen = inside_images(places, depths, views.cameras, near, far)
    return InitialPoints(points.float(), _mean_colors(views, places, seen), "random")


def _within_typical_depths(points: Tensor, seen: Tensor, cameras: PinholeCamera) -> Tensor:
    """Whether the depths of a point lie, in all its views, between half the 1st and twice the 99th percentile."""
    _, depths = project_points(points, cameras)
    if not seen.any():
        return torch.zeros(len(points), dtype=torch.bool)
    least, most = np.quantile(depths[seen], (0.01, 0.99)).tolist()  # torch.quantile takes up to 16 million values
    good: Tensor = ((depths > 0.5 * least) & (depths < 2.0 * most)) | ~seen
    return good.all(1)


def _has_neighbours(points: Tensor, seen: Tensor, cameras: PinholeCamera) -> Tensor:
    """Whether a point has others near it. Isolated points would get a huge scale, and are usually false matches."""
    _, depths = project_points(points, cameras)
    spacing = log_spacing(points).exp() * (cameras.fx.double().cpu() / depths).masked_fill(~seen, 0.0).amax(1)
    return spacing < MAX_SPACING * spacing.median()


def _depth_range(points: Tensor, cameras: PinholeCamera) -> tuple[float, float]:
    """The expected range of depths: from the points if there are at least two, else from the cameras."""
    if len(points) > 1:
        _, depths = project_points(points, cameras)
        least, most = np.quantile(depths[depths > 0], (0.01, 0.99)).tolist()
        return 0.8 * least, 1.25 * most
    centers, axes = camera_centers(cameras.extrinsics), cameras.extrinsics[:, 2, :3].double().cpu()
    if (meeting := meeting_point(cameras.extrinsics)) is not None:
        depths = ((meeting - centers) * axes).sum(1)
        return 0.3 * float(depths.min()), 2.0 * float(depths.max())
    baseline = float(torch.cdist(centers, centers).max()) or 1.0
    return baseline, 20.0 * baseline


def _sweep_range(points: Tensor, views: Views) -> tuple[float, float]:
    """The depths of the plane sweep: wider than those of all points, since cutting off the background costs quality."""
    depths = depths_in_images(points, views.cameras)
    return 0.85 * float(depths.min()), 1.3 * float(depths.max())


def _random_points(views: Views, count: int, near: float, far: float, generator: torch.Generator) -> Tensor:
    """Points of even density in the space that at least two views see, or one view if there is no such space."""
    size = torch.tensor([views.images.shape[-1], views.images.shape[-2]])
    found: list[Tensor] = []
    for required in [min(2, len(views))] * 50 + [1] * 50:
        draws = torch.rand(4 * count, 4, generator=generator, dtype=torch.float64)
        view = (torch.rand(4 * count, generator=generator, dtype=torch.float32) * len(views)).long()
        depths = (near**3 + draws[:, 2] * (far**3 - near**3)) ** (1 / 3)
        points = unproject(draws[:, :2] * size - 0.5, depths, view, views.cameras)
        # a place that k views see is drawn k times as often, so it is kept with probability required / k
        seeing = inside_images(*project_points(points, views.cameras), views.cameras, near, far).sum(1)
        found.append(points[(seeing >= required) & (draws[:, 3] * seeing < required)])
        if sum(map(len, found)) >= count:
            break
    return torch.cat(found)[:count]


def _mean_colors(views: Views, pixels: Tensor, seen: Tensor) -> Tensor:
    """The mean of the images' colours at pixels `(P, V, 2)`, over the views where `seen` `(P, V)`."""
    images = views.images.cpu()
    span = torch.tensor([max(images.shape[-1] - 1, 1), max(images.shape[-2] - 1, 1)])
    grid = (2.0 * pixels / span - 1.0).transpose(0, 1)[:, :, None].to(images.dtype)
    samples = torch.nn.functional.grid_sample(images, grid, padding_mode="border", align_corners=True)[..., 0]
    weights = (seen / seen.sum(1, keepdim=True)).T[:, None].to(images.dtype)
    return torch.where(weights > 0, weights * samples, 0.0).sum(0).T.clamp(0.0, 1.0).contiguous()
