"""Where depth maps agree: similar depths of several views are averaged, and pixels kept that another view confirms.

The average has a smaller error than each of its depths, and views that differed by a little then agree.
"""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from kgs.datasets.scene import Views
from kgs.geometry import nearest_pixels, project_points, unproject

from .plane_sweep import DepthMap

SIMILAR = 0.03  # relative difference up to which depths are averaged
# Two views agree on a point if their depths differ by less than this share, or its positions in the image by less than
# so many pixels: where a point is far away or planes lie far apart, depths are less precise than positions.
AGREEMENT, AGREEMENT_PIXELS = 0.01, 0.5
# A pixel is kept if more than half of the window around it agree with another view, as it does: views also agree by
# chance, but rarely side by side. Of a straight edge, three fifths of the window lie on the pixel's own side.
WINDOW, SUPPORT = 5, 13


def average_depths(views: Views, maps: list[DepthMap], certain: list[Tensor]) -> list[DepthMap]:
    """Depth maps with the mean of the inverse depths of a certain pixel and of the views with a similar depth there.

    `certain` holds masks `(H, W)`; the other pixels keep their depths.
    """
    averaged = []
    for view, own in enumerate(maps):
        rows, columns, points = _points(views, own, certain[view], view)
        total, count = 1 / own.depths[rows, columns].double(), torch.ones(len(rows), dtype=torch.float64)
        for other, pixels, depths in _in_other_views(views, points, view):
            x, y, inside = nearest_pixels(pixels, depths, *own.depths.mT.shape)
            there = 1 / _interpolate(1 / maps[other].depths.double(), pixels)
            found = unproject(pixels, there, torch.full_like(x, other), views.cameras)
            seen = project_points(found, views.camera(view))[1][:, 0]
            similar = inside & certain[other][y, x] & ((there / depths - 1).abs() < SIMILAR) & (seen > 0)
            total += torch.where(similar, 1 / seen, 0.0)
            count += similar
        depths = own.depths.clone()
        depths[rows, columns] = (count / total).float()
        averaged.append(replace(own, depths=depths))
    return averaged


def agreed_points(views: Views, maps: list[DepthMap], certain: list[Tensor], view: int) -> tuple[Tensor, Tensor]:
    """The points `(P, 3)` of one view's certain pixels that another view and their neighbours confirm, float64.

    Also returns their pixels, as columns and rows `(P, 2)`.
    """
    rows, columns, points = _points(views, maps[view], certain[view], view)
    camera = views.camera(view)
    agreed = torch.zeros(len(points), dtype=torch.bool)
    for other, pixels, depth in _in_other_views(views, points, view):
        x, y, inside = nearest_pixels(pixels, depth, *maps[view].depths.mT.shape)
        there = maps[other].depths[y, x].double()
        # The other view's pixel as this view sees it: at the other view's depth, and at that of the point.
        seen, owners = torch.stack([x, y], 1), torch.full_like(x, other)
        back = [project_points(unproject(seen, z, owners, views.cameras), camera)[0][:, 0] for z in (there, depth)]
        apart = (back[0] - back[1]).norm(dim=1)
        near = ((there / depth - 1).abs() < AGREEMENT) | (apart < AGREEMENT_PIXELS)
        agreed |= inside & near & certain[other][y, x]
    counted = torch.zeros_like(maps[view].depths)
    counted[rows, columns] = agreed.float()
    size, border = (WINDOW, WINDOW), cv2.BORDER_REPLICATE
    counted = torch.from_numpy(cv2.boxFilter(counted.numpy(), -1, size, normalize=False, borderType=border))
    agreed &= counted[rows, columns] >= SUPPORT
    return points[agreed], torch.stack([columns, rows], 1)[agreed]


def _points(views: Views, own: DepthMap, certain: Tensor, view: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rows and columns `(P,)` of a view's certain pixels, and their points `(P, 3)`, float64."""
    rows, columns = certain.nonzero().unbind(1)
    depths = own.depths[rows, columns].double()
    return rows, columns, unproject(torch.stack([columns, rows], 1), depths, torch.full_like(rows, view), views.cameras)


def _in_other_views(views: Views, points: Tensor, view: int) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Each other view, with the positions `(P, 2)` and depths `(P,)` of points in it."""
    pixels, depths = project_points(points, views.cameras)
    return ((other, pixels[:, other], depths[:, other]) for other in range(len(views)) if other != view)


def _interpolate(image: Tensor, pixels: Tensor) -> Tensor:
    """The values `(P,)` of an image `(H, W)` at positions `(P, 2)`, bilinear; outside, those of the border."""
    last = torch.tensor([image.shape[1] - 1, image.shape[0] - 1])
    grid = (2 * pixels / last - 1)[None, None]
    values: Tensor = grid_sample(image[None, None], grid, padding_mode="border", align_corners=True)[0, 0, 0]
    return values
