"""Dense initial points: points of the training views' depth maps on which two views agree."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.geometry import nearest_pixels, project_points, unproject
from kgs.io.console import Stage, silent

from .plane_sweep import MOST_PLANES, DepthMap, planes_wanted, sweep_depths

SCORE = 0.6  # least matching score of a point's patch
MOST_PIXELS, MOST_PIXELS_OF_ALL = 250_000, 1_600_000  # of one view, and of all views together
SMALLEST = 64  # side of an image that is not halved just to need fewer planes
# Two views agree on a point if their depths differ by less than this share, or its positions in the image by less than
# so many pixels: where a point is far away or planes lie far apart, depths are less precise than positions.
AGREEMENT, AGREEMENT_PIXELS = 0.01, 0.5


def dense_points(
    views: Views,
    near: float,
    far: float,
    count: int,
    generator: torch.Generator,
    stage: Stage = silent,
    backend: str = "auto",
    draw: str = "uniform",
) -> tuple[Tensor, Tensor, int]:
    """At most `count` points on which two views agree, between the depths `near` and `far`, drawn at random.

    Returns the points and RGB, both `(P, 3)`, and how many they were drawn from.

    `draw` is "uniform", or "spread" evenly over the images: one point from each of about as many cells. Points lie
    where the pixels of both views are usable. To bound time and memory, images are halved until they are not too large
    together, and move by no more pixels than a sweep has planes.
    """
    while (pixels := views.images[0, 0].numel()) > MOST_PIXELS or len(views) * pixels > MOST_PIXELS_OF_ALL:
        views = views.halved()
    while planes_wanted(views, near, far) > MOST_PLANES and min(views.images.shape[-2:]) >= 2 * SMALLEST:
        views = views.halved()
    maps = sweep_depths(views, near, far, stage, backend)
    certain = [there.is_inner & (there.scores > SCORE) for there in maps]
    if (usable := views.usable) is not None:
        certain = [good & there for good, there in zip(certain, usable.cpu(), strict=True)]
    found = [_agreed(views, maps, certain, view) for view in range(len(views))]
    points, colors, places = (torch.cat(parts) for parts in zip(*found, strict=True))
    chosen = torch.randperm(len(points), generator=generator)
    chosen = chosen[_one_per_cell(places[chosen].numpy(), count)] if draw == "spread" else chosen[:count]
    return points[chosen].float(), colors[chosen], len(points)


def _one_per_cell(places: NDArray[np.int64], count: int) -> Tensor:
    """The rows of the first place `(view, x, y)` in each of at most `count` square cells, as small as that allows."""
    first, across = np.arange(len(places)), places.max(initial=0) + 1
    least, most = 1.0, float(across)  # side of a cell, in pixels; found by bisection
    while len(first) > count or (len(places) > count and most - least > 1e-3):
        side = 0.5 * (least + most)
        columns, rows = (places[:, 1:] / side).astype(np.int64).T
        _, first = np.unique((places[:, 0] * across + columns) * across + rows, return_index=True)
        least, most = (side, most) if len(first) > count else (least, side)
        if most - least < 1e-9:
            break  # more views than points
    return torch.from_numpy(np.sort(first))[:count]


def _agreed(views: Views, maps: list[DepthMap], certain: list[Tensor], view: int) -> tuple[Tensor, Tensor, Tensor]:
    """The points of one view's certain pixels that another view confirms, their colours, and their `(view, x, y)`."""
    here, camera = maps[view].depths, views.camera(view)
    rows, columns = certain[view].nonzero().unbind(1)
    pixels = torch.stack([columns, rows], 1)
    points = unproject(pixels, here[rows, columns].double(), torch.full_like(rows, view), views.cameras)
    pixels, depths = project_points(points, views.cameras)
    agreed = torch.zeros(len(points), dtype=torch.bool)
    for other in set(range(len(views))) - {view}:
        depth = depths[:, other]
        x, y, inside = nearest_pixels(pixels[:, other], depth, *here.mT.shape)
        there = maps[other].depths[y, x].double()
        # The other view's pixel as this view sees it: at the other view's depth, and at that of the point.
        seen, owners = torch.stack([x, y], 1), torch.full_like(x, other)
        back = [project_points(unproject(seen, z, owners, views.cameras), camera)[0][:, 0] for z in (there, depth)]
        apart = (back[0] - back[1]).norm(dim=1)
        near = ((there / depth - 1).abs() < AGREEMENT) | (apart < AGREEMENT_PIXELS)
        agreed |= inside & near & certain[other][y, x]
    places = torch.stack([torch.full_like(rows, view), columns, rows], 1)[agreed]
    return points[agreed], views.images[view].cpu()[:, rows, columns].mT[agreed], places
