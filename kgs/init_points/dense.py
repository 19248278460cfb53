"""Dense initial points: points of the training views' depth maps on which two views agree.

The sweep reaches infinity, where the sky is: without points there, a fit paints the sky with Gaussians near the scene,
which fog the view of cameras beside the photos'. Points of the sky are a minority, so that the median of all depths
stays that of the scene.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from numpy.typing import NDArray
from torch import Tensor

from kgs._support.errors import quantity
from kgs._support.progress import ProgressBar, silent
from kgs._support.shown import ShownByShapes
from kgs.datasets.scene import Views
from kgs.geometry.cameras import to
from kgs.geometry.multiview import unproject

from .agreement import average_depths, consistent_pixels
from .depth_maps import map_depths
from .patches import PatchColors, patch_colors
from .plane_sweep import DepthMap, plane_count, planes_wanted, sweep_depths

SCORE = 0.35  # the least matching score of a point; noise reaches 0.3 along a smooth surface
MAX_PIXELS = 250_000  # of one view
MAX_PIXELS_OF_ALL = 1_600_000  # of all views together
MAX_SAMPLES = 350_000_000  # pixels of all views, times the planes of the sweep: bounds its time
SKY = 2.0  # points farther than this times the scene's largest depth belong to the sky
PER_SKY = 2  # the least number of points of the scene for each point of the sky
# Pixels by which an image moves from the nearest plane to the farthest one: planes lie at most two pixels apart.
MAX_SHIFT = 512
SMALLEST = 64  # pixels, the least side of an image that was halved for this
# The number of points for a count of None: one for so many pixels with an agreed depth, between two limits.
PIXELS_OF_A_POINT = 3
MIN_POINTS = 30_000
MAX_POINTS = 60_000
FEW_VIEWS = 3
MAX_POINTS_FEW_VIEWS = 90_000  # of up to so few views; with more, such fits take 1.4 times as long


@dataclass(frozen=True, eq=False, repr=False)
class Reserve(ShownByShapes):
    """The points on which two views agree that were not drawn.

    Args:
        points: in the frame of the views, `(P, 3)` float32 on the CPU.
        colors: RGB in [0, 1], `(P, 3)` float32.
        views: the number of the view that each point and its colour are from, `(P,)` int64.
    """

    points: Tensor
    colors: Tensor
    views: Tensor


class DensePoints(NamedTuple):
    """Points on which two views agree, then those of the photos' depth maps, if any, where no two agree."""

    points: Tensor  # (P, 3) float32
    colors: Tensor  # (P, 3), RGB in [0, 1]
    agreed: int  # how many points were agreed on, without those of the sky
    patches: PatchColors  # the colours of all agreed patches
    views: Tensor  # (P,), the view that each colour is from
    reserve: Reserve
    notes: tuple[str, ...] = ()  # on the points of the photos' depth maps


def dense_points(
    views: Views,
    near: float,
    far: float,
    count: int | None,
    generator: torch.Generator,
    bar: ProgressBar = silent,
    backend: str = "auto",
    draw: str = "uniform",
    pixels: int | None = None,
    device: torch.device | None = None,
) -> DensePoints:
    """At most `count` points on which two views agree, drawn at random, and with `views.depths` others between them.

    The scene lies between the depths `near` and `far`; the sky behind it gets points, too.

    A `count` of None is one point for every `PIXELS_OF_A_POINT` pixels with an agreed depth, between `MIN_POINTS` and
    `MAX_POINTS` (`MAX_POINTS_FEW_VIEWS`), in images that have together `pixels` pixels, or those of the views.

    `draw` is "uniform", or "spread" evenly over the images: one point from each of about as many cells. Points lie
    where the pixels of both views are usable. Depth maps are made on `device`, None for a CPU; points are on the CPU.

    Where no two views agree there are points of `views.depths`, as densely as the others, but one for
    `PIXELS_OF_A_POINT` pixels at most. With a `count` of None they are more points, at most as many again.
    """
    pixels = pixels or views.images[:, 0].numel()
    views = small_enough(views, near, far)
    maps, certain = agreed_depths(views, near, far, bar, backend, device)
    cameras = to(views.cameras, "cpu", torch.float64)
    agreed = [consistent_pixels(cameras, maps, certain, view) for view in range(len(views))]
    points, colors, view_pixels = _points_at(views, cameras, [depth_map.depths for depth_map in maps], agreed)
    filled, errors = map_depths(views, cameras, maps, agreed, near / SKY, SKY * far)
    more_points, more_colors, more_pixels = _points_at(views, cameras, filled, [depths > 0 for depths in filled])
    if count is None:
        all_pixels = views.images[:, 0].numel()
        agreed_pixels = round(pixels * len(points) / all_pixels)
        maximum = MAX_POINTS_FEW_VIEWS if len(views) <= FEW_VIEWS else MAX_POINTS
        count = min(max(agreed_pixels // PIXELS_OF_A_POINT, MIN_POINTS), maximum)
        density = min(count / max(agreed_pixels, 1), 1 / PIXELS_OF_A_POINT)
        more = min(round(density * pixels * len(more_points) / all_pixels), maximum)
    else:
        more = min(round(count * len(more_points) / max(len(points) + len(more_points), 1)), count - 1)
        count -= more
    view, x, y = view_pixels.unbind(1)
    is_sky = torch.stack([depth_map.depths for depth_map in maps])[view, y, x] > SKY * far
    chosen = _drawn(view_pixels, count, generator, draw)
    chosen = chosen[_with_less_sky(is_sky[chosen])]
    of_view = [view_pixels[view == i, 1:] for i in range(len(views))]
    patches = patch_colors(views, cameras, maps, certain, of_view)
    is_left = torch.ones(len(points), dtype=torch.bool).index_fill(0, chosen, False)
    reserve = Reserve(points[is_left].float(), colors[is_left], view[is_left])
    drawn = [points[chosen].float(), colors[chosen], view[chosen]]
    notes = list[str]()
    if errors:
        others = _drawn(more_pixels, more, generator, draw)
        parts = [more_points[others].float(), more_colors[others], more_pixels[others, 0]]
        drawn = [torch.cat(pair) for pair in zip(drawn, parts, strict=True)]
        of_maps = f"{len(errors)} of {quantity(len(views), 'photo')}"
        off = f"{float(np.median(errors)):.1%} off where photos agree"
        notes.append(f"initial points from depth maps: {len(others)}, from the maps of {of_maps}, which are {off}")
    agreed_count = int((~is_sky).sum())
    return DensePoints(drawn[0], drawn[1], agreed_count, patches, drawn[2], reserve, tuple(notes))


def small_enough(views: Views, near: float, far: float) -> Views:
    """The views, halved until a sweep takes not too long, and its planes are at most two pixels apart."""
    while views.images[0, 0].numel() > MAX_PIXELS or views.images[:, 0].numel() > MAX_PIXELS_OF_ALL:
        views = views.downsample(2)
    while min(views.images.shape[-2:]) >= 2 * SMALLEST:
        shift = planes_wanted(views, near, far)
        if shift <= MAX_SHIFT and views.images[:, 0].numel() * plane_count(shift) <= MAX_SAMPLES:
            break
        views = views.downsample(2)
    return views


def agreed_depths(
    views: Views,
    near: float,
    far: float,
    bar: ProgressBar = silent,
    backend: str = "auto",
    device: torch.device | None = None,
) -> tuple[list[DepthMap], list[Tensor]]:
    """The depth maps of the views, averaged, and the pixels that count: inside, usable and well matched."""
    maps = sweep_depths(views, near, far, bar, backend, device)
    certain = [depth_map.is_inner & (depth_map.scores > SCORE) for depth_map in maps]
    usable = views.usable
    if usable is not None:
        certain = [mask & part for mask, part in zip(certain, usable.cpu(), strict=True)]
    return average_depths(to(views.cameras, "cpu", torch.float64), maps, certain), certain


def _drawn(view_pixels: Tensor, count: int, generator: torch.Generator, draw: str) -> Tensor:
    """The rows of at most `count` of these pixels `(view, x, y)`, in random order unless they are spread."""
    chosen = torch.randperm(len(view_pixels), generator=generator)
    return chosen[_one_per_cell(view_pixels[chosen].numpy(), count)] if draw == "spread" else chosen[:count]


def _with_less_sky(is_sky: Tensor) -> Tensor:
    """The rows of all points of the scene, and of the first points of the sky: one for each `PER_SKY` of the scene."""
    maximum = int((~is_sky).sum()) // PER_SKY
    rows: Tensor = (~is_sky | (is_sky.cumsum(0) <= maximum)).nonzero()[:, 0]
    return rows


def _one_per_cell(view_pixels: NDArray[np.int64], count: int) -> Tensor:
    """The rows of the first pixel `(view, x, y)` in each of at most `count` square cells, as small as that allows."""
    first = np.arange(len(view_pixels))
    views, width, height = view_pixels.max(0, initial=0).tolist()
    view, x, y = view_pixels.T
    minimum, maximum = 1.0, max(width, height) + 1.0  # limits of a cell's side in pixels, for bisection
    while len(first) > count or (len(view_pixels) > count and maximum - minimum > 1e-3):
        side = 0.5 * (minimum + maximum)
        shape = (views + 1, int(width / side) + 1, int(height / side) + 1)
        cells = np.ravel_multi_index((view, (x / side).astype(np.int64), (y / side).astype(np.int64)), shape)
        first = _first_of_each(cells, math.prod(shape))
        minimum, maximum = (side, maximum) if len(first) > count else (minimum, side)
        if maximum - minimum < 1e-9:
            break  # more views than points
    return torch.from_numpy(np.sort(first))[:count]


def _first_of_each(numbers: NDArray[np.int64], end: int) -> NDArray[np.int64]:
    """Where each of the numbers below `end` comes first, as `np.unique` finds it, without sorting them."""
    first = np.full(end, -1)
    first[numbers[::-1]] = np.arange(len(numbers))[::-1]  # of equal numbers the last one that is assigned stays
    return first[first >= 0]


def _points_at(
    views: Views, cameras: PinholeCamera, depths: list[Tensor], chosen: list[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """The points of the chosen pixels `(H, W)` of each view at its depths, their colours, and their `(view, x, y)`."""
    parts = []
    for view, own in enumerate(depths):
        rows, columns = chosen[view].nonzero().unbind(1)
        pixels = torch.stack([columns, rows], 1)
        points = unproject(cameras, pixels, own[rows, columns].double(), torch.full_like(rows, view))
        view_pixels = torch.stack([torch.full_like(rows, view), columns, rows], 1)
        parts.append((points, views.images[view].cpu()[:, rows, columns].mT, view_pixels))
    points, colors, view_pixels = map(torch.cat, zip(*parts, strict=True))
    return points, colors, view_pixels
