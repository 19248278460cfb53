"""Agreement of depth maps: similar depths of several views are averaged, then pixels that no view confirms are dropped.

The average has a smaller error than each of its depths, and views that differed by a little then agree.
"""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor
from torch.nn.functional import grid_sample

from kgs.geometry.multiview import nearest_pixels, relative_projection

from .plane_sweep import DepthMap

SIMILAR = 0.03  # relative difference up to which depths are averaged
# Two views agree on a point if their depths differ by less than this share, or its positions in the image by less than
# so many pixels: where a point is far away or planes lie far apart, depths are less precise than positions.
AGREEMENT = 0.01
AGREEMENT_PIXELS = 0.5
# A pixel needs more than half of the window around it to agree with another view, as it does: views also agree by
# chance, but rarely side by side. Of a straight edge, three fifths of the window lie on the pixel's own side.
WINDOW = 5
SUPPORT = 13
# Views also agree by chance on small pieces of surface, far from the others. There a pixel needs two other views.
MIN_PIECE = 0.001  # of the image's pixels; smaller pieces are small
JUMP = 0.01  # difference of inverse depths between neighbours at which a piece ends, of the range of all that agree
AROUND = 0.1  # of the image's width, the side of the window in which a small piece is compared with large ones
MARGIN = 0.03  # of the range, by which it may lie before or behind all of these
LEVELS = 30_000  # of inverse depths, for OpenCV's filter
NO_LEVEL = -LEVELS


def average_depths(cameras: PinholeCamera, maps: list[DepthMap], certain: list[Tensor]) -> list[DepthMap]:
    """Depth maps with the mean of the inverse depths of a certain pixel and of the views with a similar depth there.

    `certain` holds masks `(H, W)`; the other pixels keep their depths.
    """
    inverse = [1 / depth_map.depths.double() for depth_map in maps]
    averaged = []
    for view, own in enumerate(maps):
        rows, columns = certain[view].nonzero().unbind(1)
        total = inverse[view][rows, columns]
        count = torch.ones_like(total)
        for other, pixels, depths in _in_other_views(cameras, own.depths[rows, columns], rows, columns, view):
            x, y, inside = nearest_pixels(pixels, depths, *own.depths.mT.shape)
            other_depths = 1 / interpolate(inverse[other][None], pixels)[:, 0]
            turn, shift = relative_projection(cameras, other, view)
            own_depths = convert_points_to_homogeneous(pixels) @ turn[2] * other_depths + shift[2]
            similar = (other_depths / depths - 1).abs() < SIMILAR
            similar &= inside & certain[other][y, x] & (own_depths > 0)
            total += torch.where(similar, 1 / own_depths, 0.0)
            count += similar
        depths = own.depths.clone()
        depths[rows, columns] = (count / total).float()
        averaged.append(replace(own, depths=depths))
    return averaged


def consistent_pixels(cameras: PinholeCamera, maps: list[DepthMap], certain: list[Tensor], view: int) -> Tensor:
    """Which of one view's certain pixels another view and their neighbours confirm, `(H, W)`."""
    views = confirming_views(cameras, maps, certain, view)
    confirmed = views > 0
    window = (WINDOW, WINDOW)
    counts = cv2.boxFilter(confirmed.float().numpy(), -1, window, normalize=False, borderType=cv2.BORDER_REPLICATE)
    agreed = confirmed & (torch.from_numpy(counts) >= SUPPORT)
    return agreed & (~_strays(maps[view].depths, agreed) | (views >= min(2, len(maps) - 1)))


def confirming_views(cameras: PinholeCamera, maps: list[DepthMap], certain: list[Tensor], view: int) -> Tensor:
    """The number of other views that agree with each of one view's certain pixels, `(H, W)`."""
    rows, columns = certain[view].nonzero().unbind(1)
    views = torch.zeros_like(maps[view].depths)
    for _, _, agrees in agreeing_views(cameras, maps, certain, rows, columns, view):
        views[rows, columns] += agrees
    return views


def _strays(depths: Tensor, mask: Tensor) -> Tensor:
    """The pixels of a mask in small pieces of surface that lie before or behind all large pieces around them."""
    if not mask.any():
        return mask
    inverse = torch.where(mask, 1 / depths, 0.0)
    minimum = inverse[mask].min()
    shares = ((inverse - minimum) / (inverse.max() - minimum).clamp_min(1e-30)).numpy()
    levels = np.where(mask, np.rint(LEVELS * shares), NO_LEVEL).astype(np.int16)
    cv2.filterSpeckles(levels, NO_LEVEL, int(MIN_PIECE * mask.numel()), JUMP * LEVELS)
    is_large = levels != NO_LEVEL
    side = int(AROUND * mask.shape[1]) // 2 * 2 + 1
    kernel = np.ones((side, side), np.uint8)
    nearest = cv2.dilate(np.where(is_large, shares, -np.inf), kernel)
    farthest = cv2.erode(np.where(is_large, shares, np.inf), kernel)
    is_around = (shares >= farthest - MARGIN) & (shares <= nearest + MARGIN)
    return mask & torch.from_numpy(~is_large & ~is_around)


def agreeing_views(
    cameras: PinholeCamera, maps: list[DepthMap], certain: list[Tensor], rows: Tensor, columns: Tensor, view: int
) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Each other view, the positions `(P, 2)` of one view's pixels in it, and where it agrees, bool `(P,)`."""
    own_depths = maps[view].depths[rows, columns]
    for other, pixels, depths in _in_other_views(cameras, own_depths, rows, columns, view):
        x, y, inside = nearest_pixels(pixels, depths, *maps[view].depths.mT.shape)
        other_depths = maps[other].depths[y, x].double()
        # the other view's pixel as this view sees it: at the other view's depth, and at that of the point
        turn, shift = relative_projection(cameras, other, view)
        rays = _rays(x, y) @ turn.mT
        at_other_depth = _dehomogenise(rays * other_depths[:, None] + shift)
        at_own_depth = _dehomogenise(rays * depths[:, None] + shift)
        apart = (at_other_depth - at_own_depth).norm(dim=1)
        near = ((other_depths / depths - 1).abs() < AGREEMENT) | (apart < AGREEMENT_PIXELS)
        yield other, pixels, inside & near & certain[other][y, x]


def before_surfaces(
    cameras: PinholeCamera, maps: list[DepthMap], agreed: list[Tensor], depths: Tensor, view: int
) -> Tensor:
    """Which pixels of a view at depths `(H, W)` lie before what another view agrees on, bool `(H, W)`.

    That view would see them there. Pixels of depth 0 are passed over.
    """
    hides = torch.zeros_like(depths, dtype=torch.bool)
    rows, columns = depths.nonzero().unbind(1)
    for other, pixels, there in _in_other_views(cameras, depths[rows, columns], rows, columns, view):
        x, y, inside = nearest_pixels(pixels, there, *depths.mT.shape)
        is_before = there < (1 - SIMILAR) * maps[other].depths[y, x]
        hides[rows, columns] |= inside & agreed[other][y, x] & is_before
    return hides


def _in_other_views(
    cameras: PinholeCamera, depths: Tensor, rows: Tensor, columns: Tensor, view: int
) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Each other view, with the positions `(P, 2)` and depths `(P,)` in it of a view's pixels at some depths."""
    rays = _rays(columns, rows) * depths.double()[:, None]
    for other in range(cameras.batch_size):
        if other != view:
            turn, shift = relative_projection(cameras, view, other)
            there = rays @ turn.mT + shift
            yield other, _dehomogenise(there), there[:, 2]


def _rays(x: Tensor, y: Tensor) -> Tensor:
    """(x, y, 1) of each pixel, `(P, 3)` float64."""
    return torch.stack([x, y, torch.ones_like(x)], 1).double()


def _dehomogenise(homogeneous: Tensor) -> Tensor:
    """Pixels `(P, 2)` of homogeneous ones; invalid at depth <= 0."""
    return homogeneous[:, :2] / homogeneous[:, 2:]


def interpolate(image: Tensor, pixels: Tensor) -> Tensor:
    """The values `(P, C)` of an image `(C, H, W)` at positions `(P, 2)`, bilinear; outside, those of the border."""
    last = torch.tensor([max(image.shape[2] - 1, 1), max(image.shape[1] - 1, 1)])
    grid = (2 * pixels / last - 1)[None, None].to(image.dtype)
    values: Tensor = grid_sample(image[None], grid, padding_mode="border", align_corners=True)[0, :, 0].T
    return values
