"""A dense first cloud: depth maps of the training views, kept where the views agree."""

from __future__ import annotations

import torch
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.fit.progress import Stage, silent

from .plane_sweep import DepthMap, sweep_depths
from .triangulate import project_all, unproject

__all__ = ["dense_points"]

SCORE = 0.6  # a patch has to match at least so well
MOST_PIXELS, MOST_PIXELS_OF_ALL = 250_000, 1_600_000
AGREEMENT = 0.01  # relative difference of the depths that two views have of a point


def dense_points(
    views: Views, near: float, far: float, count: int, generator: torch.Generator, stage: Stage = silent
) -> tuple[Tensor, Tensor]:
    """Points on the surfaces that at least two views agree on, with their colours there.

    Where the views have masks, points lie where the masks of both are above 0.5.

    Large pictures, and many of them, are swept at half the width and height, or a quarter: they give enough points, in
    bounded time and memory.

    Args:
        views: at least two, posed.
        near: depth of the nearest surface, > 0.
        far: of the farthest.
        count: how many to draw from all that were found, at random.
        generator: of the draw.
        stage: shows how far the work is.

    Returns:
        Points `(P, 3)` float32 in the frame of the views, P <= count, and RGB `(P, 3)` in [0, 1].
    """
    while (pixels := views.images[0, 0].numel()) > MOST_PIXELS or len(views) * pixels > MOST_PIXELS_OF_ALL:
        views = views.halved()
    maps = sweep_depths(views, near, far, stage=stage)
    certain = [there.is_inner & (there.scores > SCORE) for there in maps]
    if views.masks is not None:
        certain = [pixels & (mask[0] > 0.5).cpu() for pixels, mask in zip(certain, views.masks, strict=True)]
    found = [_agreed(views, maps, certain, view) for view in range(len(views))]
    points, colors = (torch.cat(parts) for parts in zip(*found, strict=True))
    chosen = torch.randperm(len(points), generator=generator)[:count]
    return points[chosen].float(), colors[chosen]


def _agreed(views: Views, maps: list[DepthMap], certain: list[Tensor], view: int) -> tuple[Tensor, Tensor]:
    """The points of one view's certain pixels that another view's have too, and their colours in that view."""
    here = maps[view]
    rows, columns = certain[view].nonzero().unbind(1)
    depths = here.depths[rows, columns].double()
    points = unproject(torch.stack([columns, rows], 1), depths, torch.full_like(rows, view), views.cameras)
    pixels, depths = project_all(points, views.cameras)
    height, width = here.depths.shape
    agreed = torch.zeros(len(points), dtype=torch.bool)
    for other, there in enumerate(maps):
        if other == view:
            continue
        x, y = pixels[:, other].round().unbind(1)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (depths[:, other] > 0)
        x, y = (torch.where(inside, value, 0.0).long() for value in (x, y))
        close = (there.depths[y, x] / depths[:, other] - 1).abs() < AGREEMENT
        agreed |= inside & close & certain[other][y, x]
    return points[agreed], views.images[view].cpu()[:, rows, columns].mT[agreed]
