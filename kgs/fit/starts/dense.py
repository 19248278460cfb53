"""A dense first cloud: points of the training views' depth maps, where the views agree."""

import torch
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.fit.progress import Stage, silent

from .plane_sweep import DepthMap, sweep_depths
from .triangulate import project_all, unproject

SCORE = 0.6  # a patch of a point has to match at least so well
MOST_PIXELS, MOST_PIXELS_OF_ALL = 250_000, 1_600_000
AGREEMENT = 0.01  # relative difference of the depths that two views have of a point


def dense_points(
    views: Views,
    near: float,
    far: float,
    count: int,
    generator: torch.Generator,
    stage: Stage = silent,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """At most `count` points between two depths that two views agree on, drawn at random, and RGB, both `(P, 3)`.

    Where the views have masks, points lie where both are above 0.5. Large pictures, and many, are swept at half the
    width and height, or a quarter: they give enough points, in bounded time and memory.
    """
    while (pixels := views.images[0, 0].numel()) > MOST_PIXELS or len(views) * pixels > MOST_PIXELS_OF_ALL:
        views = views.halved()
    maps = sweep_depths(views, near, far, stage, backend)
    certain = [there.is_inner & (there.scores > SCORE) for there in maps]
    if views.masks is not None:
        certain = [good & (mask[0] > 0.5).cpu() for good, mask in zip(certain, views.masks, strict=True)]
    found = [_agreed(views, maps, certain, view) for view in range(len(views))]
    points, colors = (torch.cat(parts) for parts in zip(*found, strict=True))
    chosen = torch.randperm(len(points), generator=generator)[:count]
    return points[chosen].float(), colors[chosen]


def _agreed(views: Views, maps: list[DepthMap], certain: list[Tensor], view: int) -> tuple[Tensor, Tensor]:
    """The points of one view's certain pixels that another view's have too, and their colours in that view."""
    here = maps[view].depths
    rows, columns = certain[view].nonzero().unbind(1)
    pixels = torch.stack([columns, rows], 1)
    points = unproject(pixels, here[rows, columns].double(), torch.full_like(rows, view), views.cameras)
    pixels, depths = project_all(points, views.cameras)
    agreed = torch.zeros(len(points), dtype=torch.bool)
    for other in set(range(len(views))) - {view}:
        places, depth = pixels[:, other].round(), depths[:, other]
        inside = ((places >= 0) & (places < torch.tensor(here.mT.shape))).all(1) & (depth > 0)
        x, y = torch.where(inside[:, None], places, 0.0).long().unbind(1)
        agreed |= inside & ((maps[other].depths[y, x] / depth - 1).abs() < AGREEMENT) & certain[other][y, x]
    return points[agreed], views.images[view].cpu()[:, rows, columns].mT[agreed]
