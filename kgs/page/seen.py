"""What the photos show, for the viewer: coarse depth maps of their cameras, with a range of depths in each cell.

A pixel of the viewer shows a surface at some depth. A photo shows this surface if it lies inside the photo's frame and
its distance from the photo's camera lies in the range of depths in the cell there. What no photo shows is invented by
the fit; the viewer lets it fade (`coverage.frag.glsl`).

The format: two planes of bytes, nearest depths and then farthest depths, each view by view and row by row. A byte b
of at least 1 stands for the depth exp(low + step (b - 1)); 255 as the nearest and 0 as the farthest depth mark an empty
cell.
"""

import gzip
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from kgs.camera import image_size
from kgs.datasets.splits import select_evenly
from kgs.renderer import GaussianRenderer
from kgs.types import Gaussians

MOST_CELLS = 128  # along the longer side of a photo
MOST_VIEWS = 48
_LEAST_ALPHA = 0.05  # of a pixel that shows something


class Seen(NamedTuple):
    """Depth maps of some cameras.

    Args:
        layout: what a viewer needs to decode the content: `views`, the indices of the cameras; `cell`, the side of a
            cell in pixels of the photo; `width` and `height` in cells; `low` and `step`.
        content: the planes, compressed with gzip.
    """

    layout: dict[str, Any]
    content: bytes


@torch.no_grad()
def seen_by(gaussians: Gaussians, cameras: PinholeCamera, views: list[int], near_plane: float) -> Seen:
    """The depths that photos show, from renders of the splat.

    Args:
        gaussians: the splat.
        cameras: of all photos, of one image size.
        views: which of them to use; of more than `MOST_VIEWS` an even choice is taken.
        near_plane: of the renderer, in world units.
    """
    views = [views[i] for i in select_evenly(len(views), min(len(views), MOST_VIEWS))]
    cell = math.ceil(max(image_size(cameras)) / MOST_CELLS)
    renderer = GaussianRenderer(near_plane=near_plane).eval()
    nearest, farthest = [], []
    for view in views:
        rendering = renderer(gaussians, _camera(cameras, view, gaussians.means.device), outputs=("alpha", "depth"))
        empty = rendering.alpha < _LEAST_ALPHA
        nearest.append(-_largest_in_cells(-rendering.depth.masked_fill(empty, math.inf), cell))
        farthest.append(_largest_in_cells(rendering.depth.masked_fill(empty, 0.0), cell))
    near, far = (torch.cat(maps).cpu().double().numpy() for maps in (nearest, farthest))
    codes, low, step = _logarithms(near, far)
    layout = {"views": views, "cell": cell, "width": near.shape[2], "height": near.shape[1], "low": low, "step": step}
    return Seen(layout, gzip.compress(codes.tobytes(), mtime=0))


def _camera(cameras: PinholeCamera, view: int, device: torch.device) -> PinholeCamera:
    parts = (cameras.intrinsics, cameras.extrinsics, cameras.height, cameras.width)
    return PinholeCamera(*(part[view : view + 1].to(device) for part in parts))


def _largest_in_cells(image: Tensor, cell: int) -> Tensor:
    """The largest value in each cell and next to it: `(1, 1, H, W)` to `(1, H / cell, W / cell)`, rounded up.

    The viewer draws between pixels, too.
    """
    height, width = image.shape[-2:]
    rest = [-width % cell, -height % cell]
    padded = pad(image, (1, 1 + rest[0], 1, 1 + rest[1]), value=-math.inf)
    return max_pool2d(padded, cell + 2, stride=cell)[:, 0]


def _logarithms(near: NDArray[np.float64], far: NDArray[np.float64]) -> tuple[NDArray[np.uint8], float, float]:
    """Both planes in bytes, rounded such that no range becomes narrower, with `low` and `step`."""
    full = far > 0
    if not full.any():
        return np.stack([np.full(near.shape, 255, np.uint8), np.zeros(far.shape, np.uint8)]), 0.0, 1.0
    low, high = float(np.log(near[full].min())), float(np.log(far[full].max()))
    step = (high - low) / 254 or 1.0
    with np.errstate(divide="ignore"):
        planes = [1 + np.floor((np.log(near) - low) / step), 1 + np.ceil((np.log(far) - low) / step)]
    codes = np.stack(
        [np.where(full, plane.clip(1, 255), nothing) for plane, nothing in zip(planes, (255, 0), strict=True)]
    )
    return codes.astype(np.uint8), low, step
