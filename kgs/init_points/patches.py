"""Colours of small patches of surface in the views that agree on their depth: do colours depend on the direction?"""

import math
from dataclasses import dataclass

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from kgs.datasets.scene import Views
from kgs.geometry.multiview import unproject
from kgs.geometry.rigs import camera_centers

from .agreement import agreeing_views, interpolate
from .plane_sweep import DepthMap

PIXELS = 16_000  # of one view that are looked up: one in four, or fewer of a large image
SIDE = 4  # of a patch, in these pixels
MIN_AGREED = 4  # of its 16 pixels, which a view has to agree on
VIEWS = 3  # that a patch needs: without one of them there is a mean of two
MIN_PATCHES = 200  # fewer say nothing about a scene


@dataclass(frozen=True, eq=False)
class PatchColors:
    """Colours of P patches of surface in V views.

    Args:
        colors: mean RGB of the patch's pixels, `(P, V, 3)` float32; of any value where it is not visible.
        visible: the views that show the patch and agree on its depth, three at least, bool `(P, V)`.
        directions: unit vectors from the cameras to the patch, `(P, V, 3)` float32.
    """

    colors: Tensor
    visible: Tensor
    directions: Tensor

    def __len__(self) -> int:
        return len(self.colors)


def patch_colors(
    views: Views, cameras: PinholeCamera, maps: list[DepthMap], certain: list[Tensor], agreed: list[Tensor]
) -> PatchColors:
    """The patches of all views: squares of 8 pixels, or of more in large images.

    `agreed` holds the columns and rows `(P, 2)` of each view's agreed pixels. The colour of a patch in another view is
    its own plus the mean difference, over the pixels that this view agrees on.
    """
    parts = [_of_view(views, cameras, maps, certain, pixels, view) for view, pixels in enumerate(agreed)]
    return PatchColors(*map(torch.cat, zip(*parts, strict=True)))


def _of_view(
    views: Views, cameras: PinholeCamera, maps: list[DepthMap], certain: list[Tensor], pixels: Tensor, view: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours, visibility and directions of one view's patches."""
    images = views.images.cpu().float()
    stride = max(2, math.ceil(math.sqrt(images[0, 0].numel() / PIXELS)))
    columns, rows = pixels[(pixels % stride == 0).all(1)].unbind(1)
    depths = maps[view].depths[rows, columns].double()
    points = unproject(cameras, torch.stack([columns, rows], 1), depths, torch.full_like(rows, view))
    own = images[view][:, rows, columns].T
    size = [-(-length // (stride * SIDE)) * SIDE for length in images.shape[-2:]]

    def sums(values: Tensor, here: Tensor) -> Tensor:
        """Sums `(patches, C)` of values `(P, C)`, over the pixels of each patch that are `here`."""
        grid = torch.zeros(values.shape[1], *size, dtype=values.dtype)
        grid[:, rows[here] // stride, columns[here] // stride] = values[here].T
        return SIDE**2 * avg_pool2d(grid, SIDE).flatten(1).T

    everywhere = torch.ones(len(own), dtype=torch.bool)
    one = torch.ones(len(own), 1)
    count = sums(one, everywhere)
    mean = sums(own, everywhere) / count.clamp_min(1)
    colors = mean[:, None].repeat(1, len(views), 1)
    visible = (count >= MIN_AGREED).repeat(1, len(views))
    for other, projected, agrees in agreeing_views(cameras, maps, certain, rows, columns, view):
        difference = interpolate(images[other], projected) - own
        shared = sums(one, agrees)
        colors[:, other] += sums(difference, agrees) / shared.clamp_min(1)
        visible[:, other] &= ((shared >= MIN_AGREED) & (shared >= 0.5 * count))[:, 0]
    wanted = visible.sum(1) >= VIEWS
    centers = sums(points, everywhere)[wanted] / count[wanted]
    directions = normalize(centers[:, None] - camera_centers(cameras.extrinsics), dim=-1).float()
    return colors[wanted], visible[wanted], directions
