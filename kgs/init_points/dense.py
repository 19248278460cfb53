"""A dense first cloud: points of the training views' depth maps, where the views agree."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.geometry import nearest_pixels, project_points, unproject
from kgs.io.console import Stage, silent

from .plane_sweep import MOST_PLANES, DepthMap, planes_wanted, sweep_depths

SCORE = 0.6  # a patch of a point has to match at least so well
MOST_PIXELS, MOST_PIXELS_OF_ALL, SMALLEST = 250_000, 1_600_000, 64
# Two views agree on a point whose depths differ by this share, or whose places by so many pixels: far away, and where
# planes are far apart, depths are vaguer than the pictures tell.
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
    """At most `count` points between two depths that two views agree on, drawn at random.

    Returns the points and RGB, both `(P, 3)`, and how many they were drawn from.

    The draw is "uniform", or "spread" evenly over the pictures: one point from each of about as many cells. Points
    lie where the pixels of both views are usable. Large pictures, and many, and such as move by more pixels than a
    sweep has planes, are swept at half the width and height, or a quarter: enough points, in bounded time and memory.
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
    chosen = chosen[_one_a_cell(places[chosen].numpy(), count)] if draw == "spread" else chosen[:count]
    return points[chosen].float(), colors[chosen], len(points)


def _one_a_cell(places: NDArray[np.int64], count: int) -> Tensor:
    """The rows of the first place `(view, x, y)` in each of at most `count` cells, as small as that allows."""
    first, across = np.arange(len(places)), places.max(initial=0) + 1
    least, most = 1.0, float(across)  # of the side of a cell, in pixels
    while len(first) > count or (len(places) > count and most - least > 1e-3):
        side = 0.5 * (least + most)
        columns, rows = (places[:, 1:] / side).astype(np.int64).T
        _, first = np.unique((places[:, 0] * across + columns) * across + rows, return_index=True)
        least, most = (side, most) if len(first) > count else (least, side)
        if most - least < 1e-9:
            break  # more views than points
    return torch.from_numpy(np.sort(first))[:count]


def _agreed(views: Views, maps: list[DepthMap], certain: list[Tensor], view: int) -> tuple[Tensor, Tensor, Tensor]:
    """The points of one view's certain pixels that another view's have too, their colours and places in that view."""
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
        rays = torch.stack([x, y], 1), torch.full_like(x, other)
        back = [project_points(unproject(rays[0], z, rays[1], views.cameras), camera)[0][:, 0] for z in (there, depth)]
        apart = (back[0] - back[1]).norm(dim=1)
        near = ((there / depth - 1).abs() < AGREEMENT) | (apart < AGREEMENT_PIXELS)
        agreed |= inside & near & certain[other][y, x]
    places = torch.stack([torch.full_like(rows, view), columns, rows], 1)[agreed]
    return points[agreed], views.images[view].cpu()[:, rows, columns].mT[agreed], places
