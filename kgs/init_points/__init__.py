"""Makes the initial points of a fit, from the training views only: test views are never used here."""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.checks import check_kind
from kgs._support.default_device import cpu_by_default
from kgs._support.errors import ArgumentError, quoted, warn
from kgs._support.machine import check_device
from kgs._support.progress import ProgressBar, silent
from kgs._support.shown import ShownByShapes
from kgs.backends import check_backend
from kgs.datasets.scene import Views
from kgs.geometry.cameras import project, to
from kgs.geometry.multiview import inside_images, unproject

from .agreement import interpolate
from .dense import MIN_POINTS, Reserve, dense_points
from .depth_limits import MIN_SIFT, certain_points, depth_range, sweep_range
from .files import read_points
from .patches import PatchColors

__all__ = ["InitialPoints", "initial_points"]

KINDS = ("dense", "sift", "random", "file")
DRAWS = ("uniform", "spread")
MIN_DENSE = 1000


@dataclass(frozen=True, eq=False, repr=False)
class InitialPoints(ShownByShapes):
    """The points that a fit starts from, with their colours.

    Args:
        points: in the frame of the views, `(P, 3)` float32 on the CPU.
        colors: RGB in [0, 1], `(P, 3)` float32.
        kind: where the points come from: "dense", "sift", "random", "file", or the scene's `init_kind`.
        patches: of "dense", the colours of the surface in the views that agree on it; else None.
        views: of "dense", the number of the view that each point's colour is from, `(P,)` int64; else None.
        reserve: of "dense", the points that two views agree on, too, but that were not drawn; else None.
        notes: what a user should know of them, one sentence each.
    """

    points: Tensor
    colors: Tensor
    kind: str
    patches: PatchColors | None = None
    views: Tensor | None = None
    reserve: Reserve | None = None
    notes: tuple[str, ...] = ()


@cpu_by_default
def initial_points(
    views: Views,
    kind: str = "dense",
    *,
    seed: int = 0,
    count: int | None = 10_000,
    pixels: int | None = None,
    file: str | PathLike[str] | None = None,
    origin: Tensor | None = None,
    bar: ProgressBar = silent,
    backend: str = "auto",
    draw: str = "uniform",
    device: torch.device | str = "cpu",
) -> InitialPoints:
    """Find the points that a fit starts from.

    Convention:
        Points in the frame of the views' cameras, OpenCV axes, world units.

    Args:
        views: the training views, and only these.
        kind: "dense": points of depth maps that at least two views agree on, drawn at random; if they are fewer than
            1000, "sift" with a warning. Where no two views agree, points of `views.depths`, if there are any, once
            their scale and shift are found; maps that do not fit are left out with a warning. "sift": SIFT keypoints of
            the images, matched and triangulated with the given poses; if they are fewer than 20, "random" with a
            warning. "random": spread evenly over the space that at least two of the views see (one, if there is only
            one), in the images' mean colours there; its depths are those of the SIFT points, or follow from the
            cameras. "file": the points of a 3DGS PLY file, or of a cloud or mesh that trimesh reads, up to 1 GiB.
        seed: of the random draws.
        count: how many points "random" gives, and "dense" at most; >= 1. None: of "dense" one for every 3 pixels with
            an agreed depth, 30 000 at least and 60 000 at most, 90 000 of up to three views; of "random" 30 000.
        pixels: how many pixels all images of the fit have, for a count of None; those of `views` unless given.
        file: the file of the kind "file".
        origin: subtracted from the points of the file, `(3,)`: the `offset` of the scene, if the file has its world
            coordinates.
        bar: wraps the loops to show their progress, see :mod:`kgs._support.progress`.
        backend: one of :func:`kgs.backends.available`, for "dense" and "sift".
        draw: how "dense" points are drawn: "uniform", or "spread" evenly over the images.
        device: where the depth maps of "dense" are made: on a GPU by torch. The points are on the CPU.

    Returns:
        The points. `kind` says what they are: "random" if "sift" was asked for and found too few.

    Raises:
        TypeError: `views` is not a `Views`; a whole scene, for instance.
        ValueError: another kind or draw, `count` below 1, no file for "file", or a device that cannot be used.
        DataError: the file is missing, broken, compressed, too large, or has no points.
    """
    check_kind("views", views, Views)
    if kind not in KINDS:
        raise ArgumentError("kind", f"one of {list(KINDS)}", quoted(kind))
    if draw not in DRAWS:
        raise ArgumentError("draw", f"one of {list(DRAWS)}", quoted(draw))
    if count is not None and count < 1:
        raise ArgumentError("count", "at least 1", count)
    where = check_device(str(device))
    check_backend(backend)
    if kind == "file":
        if file is None:
            raise ArgumentError("file", "a path for the kind 'file'", "None")
        return InitialPoints(*read_points(Path(file), origin), kind)
    cameras = to(views.cameras, "cpu", torch.float64)
    tracked = certain_points(views, cameras, bar, backend)
    generator = torch.Generator().manual_seed(seed)
    if kind == "dense":
        near, far = sweep_range(tracked, cameras)
        dense = dense_points(views, near, far, count, generator, bar, backend, draw, pixels, where)
        if dense.agreed >= (MIN_DENSE if count is None else min(MIN_DENSE, count)):
            parts = (dense.patches, dense.views, dense.reserve, dense.notes)
            return InitialPoints(dense.points, dense.colors, kind, *parts)
        message = (
            f"initial points: {len(views)} training views agree on {dense.agreed} points only; SIFT points instead"
        )
        warn(message)
    count = MIN_POINTS if count is None else count
    if kind in ("dense", "sift"):
        if len(tracked) >= MIN_SIFT:
            colors = _mean_colors(views.images, tracked.tracks.pixels, tracked.tracks.visible)
            return InitialPoints(tracked.points.float(), colors, "sift")
        message = f"initial points: SIFT found {len(tracked)} in {len(views)} training views, fewer than {MIN_SIFT}; "
        warn(f"{message}the fit starts from {count} random points instead")
    near, far = depth_range(tracked, cameras)
    points = _random_points(cameras, count, near, far, generator)
    projected, depths = project(cameras, points)
    inside = inside_images(cameras, projected, depths, near, far)
    usable = views.usable
    if usable is not None:
        inside &= _values_at(usable[:, None].float(), projected)[..., 0] > 0.5
    colors = _mean_colors(views.images, projected, inside)
    return InitialPoints(points.float(), colors, "random")


def _random_points(cameras: PinholeCamera, count: int, near: float, far: float, generator: torch.Generator) -> Tensor:
    """Points of even density in the space that at least two views see, or one view if there is no such space."""
    size = torch.stack([cameras.width[0], cameras.height[0]]).double()
    accepted = list[Tensor]()
    for required in [min(2, cameras.batch_size)] * 50 + [1] * 50:
        draws = torch.rand(4 * count, 4, generator=generator, dtype=torch.float64)
        view = (torch.rand(4 * count, generator=generator, dtype=torch.float32) * cameras.batch_size).long()
        depths = (near**3 + draws[:, 2] * (far**3 - near**3)) ** (1 / 3)
        points = unproject(cameras, draws[:, :2] * size - 0.5, depths, view)
        # a point that k views see is drawn k times as often, so it is accepted with probability required / k
        views_there = inside_images(cameras, *project(cameras, points), near, far).sum(1)
        accepted.append(points[(views_there >= required) & (draws[:, 3] * views_there < required)])
        if sum(map(len, accepted)) >= count:
            break
    return torch.cat(accepted)[:count]


def _mean_colors(images: Tensor, pixels: Tensor, visible: Tensor) -> Tensor:
    """The mean of the images' colours at pixels `(P, V, 2)`, over the views where `visible` `(P, V)`."""
    samples = _values_at(images, pixels)
    weights = (visible / visible.sum(1, keepdim=True))[..., None].to(samples)
    return torch.where(weights > 0, weights * samples, 0.0).sum(1).clamp(0.0, 1.0)


def _values_at(images: Tensor, pixels: Tensor) -> Tensor:
    """The values `(P, V, K)` of images `(V, K, H, W)` at positions `(P, V, 2)` in pixels."""
    return torch.stack([interpolate(image, pixels[:, view]) for view, image in enumerate(images.cpu())], 1)
