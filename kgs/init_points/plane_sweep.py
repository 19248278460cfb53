"""Depth maps from a plane sweep: planes parallel to a view's image are warped, compared, smoothed and refined.

Sources: Collins, "A Space-Sweep Approach to True Multi-Image Matching" (CVPR 1996) for the sweep; Hirschmüller, "Stereo
Processing by Semi-Global Matching and Mutual Information" (PAMI 2008), equations 11 to 14, for the smoothing.
"""

import math
from dataclasses import dataclass

import torch
from kornia.color import rgb_to_grayscale
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.errors import ArgumentError
from kgs._support.progress import ProgressBar, silent
from kgs.backends import get_backend
from kgs.datasets.scene import Views
from kgs.geometry.cameras import to
from kgs.geometry.multiview import relative_projection
from kgs.geometry.rigs import camera_centers

from .sweep_costs import sweep_costs

PLANES = 128  # fewest planes; above, one plane for each pixel by which an image moves
MAX_PLANES = 256
MAX_TO_INFINITY = 384  # planes of a sweep to infinity: these bound its memory
NEIGHBOURS = 4  # the most views that a view is compared with
BASELINE = 0.15  # the best distance of a neighbour, over the depth: shorter is less precise, longer more occluded
FARTHEST = 100.0  # the largest depth of a sweep to infinity, in units of `far`


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths and scores of the pixels of one view, `(H, W)`."""

    depths: Tensor  # z in the camera's frame (OpenCV axes), in world units; pixels have integer centres
    scores: Tensor  # how well the patch matches there, from -1 to 1
    is_inner: Tensor  # where the depth is not on the nearest or farthest plane


def sweep_depths(
    views: Views,
    near: float,
    far: float,
    bar: ProgressBar = silent,
    backend: str = "auto",
    device: torch.device | None = None,
) -> list[DepthMap]:
    """The depth map of each view, from planes evenly spread over inverse depth, from a depth to infinity.

    Planes are as far apart as the scene asks for between `near` and `far`. Beyond `far` they go on until one lies
    beyond infinity: an inverse depth below 0, so that infinity is not the last plane. There are at most
    `MAX_TO_INFINITY`, else farther apart. Depths are at most `FARTHEST` times `far`.

    If all other views are at the centre of a view, its depths are unknown and its scores -1.

    The sweep runs on `device`, None for a CPU; its results are on the CPU.
    """
    if not 0 < near < far < math.inf:
        raise ArgumentError("near, far", "0 < near < far", f"{near} and {far}")
    device = torch.device("cpu") if device is None else device
    grey = rgb_to_grayscale(views.images.to(device).float())[:, 0]
    planes = plane_count(planes_wanted(views, near, far))
    typical = 2 / (1 / near + 1 / far)
    spacing = max((1 / near - 1 / far) / (planes - 1), 1 / near / (MAX_TO_INFINITY - 2))
    inverse = 1 / near - spacing * torch.arange(math.ceil(1 / near / spacing) + 2, dtype=torch.float64, device="cpu")
    cameras = to(views.cameras, "cpu", torch.float64)
    kernels = get_backend(backend, device, required=False)
    memory = grey.new_empty(2, *grey.shape[1:], len(inverse)) if device.type == "cpu" else None
    maps = []
    for view in bar(range(len(views)), "depth maps", "view"):
        others = _neighbours(cameras, view, typical)
        if others:
            homographies = torch.stack([_homographies(cameras, view, other, inverse) for other in others])
            costs, unsmoothed = sweep_costs(grey[view], grey[others], homographies.to(device), kernels, memory)
            maps.append(_refine(costs, unsmoothed, inverse, FARTHEST * far))
        else:
            unknown = torch.full_like(grey[view], -1.0, device="cpu")
            maps.append(DepthMap(torch.full_like(unknown, far), unknown, unknown > 0))
    return maps


def plane_count(wanted: float) -> int:
    """The number of planes from `near` to `far` where so many are wanted."""
    return min(max(math.ceil(wanted), PLANES), MAX_PLANES)


def planes_wanted(views: Views, near: float, far: float) -> float:
    """By how many pixels the middle of a view moves in a neighbour from one depth to the other: the median."""
    cameras = to(views.cameras, "cpu", torch.float64)
    inverse = torch.linspace(1 / near, 1 / far, PLANES, dtype=torch.float64, device="cpu")
    middle = inverse.new_tensor([views.images.shape[-1] / 2, views.images.shape[-2] / 2, 1.0])
    steps = []
    for view in range(len(views)):
        for other in _neighbours(cameras, view, 1 / float(inverse.mean())):
            mapped = _homographies(cameras, view, other, inverse) @ middle
            mapped = mapped[mapped[:, 2] > 0]
            if len(mapped) > 1:
                pixels = mapped[:, :2] / mapped[:, 2:]
                steps.append((pixels[1:] - pixels[:-1]).norm(dim=1).median())
    return PLANES * float(torch.stack(steps).median()) if steps else 0.0


def _neighbours(cameras: PinholeCamera, view: int, depth: float) -> list[int]:
    """The views to compare with, those first whose distance is nearest to `BASELINE`."""
    centers = camera_centers(cameras.extrinsics)
    baselines = (centers - centers[view]).norm(dim=1) / depth
    order = (baselines / BASELINE).log().abs().argsort(stable=True).tolist()
    return [other for other in order if baselines[other] > 0][:NEIGHBOURS]


def _homographies(cameras: PinholeCamera, view: int, other: int, inverse: Tensor) -> Tensor:
    """From pixels of a view to those of another, for each plane, `(D, 3, 3)`: K' (R + t n^T / d) K^-1 at depth d."""
    turn, shift = relative_projection(cameras, view, other)
    homographies = turn.repeat(len(inverse), 1, 1)
    homographies[:, :, 2] += inverse[:, None] * shift
    return homographies


def _refine(cost: Tensor, unsmoothed: Tensor, inverse: Tensor, max_depth: float) -> DepthMap:
    """The depth of the cheapest plane of each pixel, refined by the lowest point of a parabola through three planes.

    It is at most `max_depth`, also where the inverse depth is 0 or below. The map is on the CPU.
    """
    best = cost.argmin(0)
    inner = best.clamp(1, len(cost) - 2)
    left = cost.gather(0, (inner - 1)[None])[0]
    middle = cost.gather(0, inner[None])[0]
    right = cost.gather(0, (inner + 1)[None])[0]
    bend = left - 2 * middle + right
    offset = torch.where(bend > 1e-9, 0.5 * (left - right) / bend.clamp_min(1e-9), 0.0).clamp(-0.5, 0.5)
    depths = 1.0 / (float(inverse[0]) + (inner + offset) * float(inverse[1] - inverse[0])).clamp_min(1.0 / max_depth)
    scores = 1.0 - unsmoothed.gather(0, best[None])[0]
    is_inner = (best > 0) & (best < len(cost) - 1)
    return DepthMap(depths.cpu(), scores.cpu(), is_inner.cpu())
