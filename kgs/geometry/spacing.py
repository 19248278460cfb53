"""The spacing of points: the initial scale of Gaussians."""

import math

import torch
from torch import Tensor

from kgs._support.errors import ArgumentError

NEIGHBOURS = 3
MIN_RELATIVE_SPACING = 1e-3
_MAX_DISTANCES = 2**24  # at a time


def log_spacing(points: Tensor) -> Tensor:
    """Logarithm of the root mean squared distance to the three nearest points, float64 `(N,)`.

    The initial scale of Gaussians. It is at least a thousandth of the cloud's median spacing, because points may
    coincide. Where points coincide in groups of four or more and more than half of the distinct points occur three or
    more times (the triangles of an STL), distances are those between distinct points.

    Args:
        points: `(N, 3)`, N >= 4, finite, not all in one place; else a ValueError.
    """
    if len(points) <= NEIGHBOURS:
        raise ArgumentError("points", f"at least {NEIGHBOURS + 1} to take a spacing from", len(points))
    points = points.double()
    centred = points - points.mean(dim=0)
    size = centred.abs().amax()
    if not 0.0 < float(size) < math.inf:
        raise ArgumentError("points", "points in different places", f"a cloud of half size {float(size):g}")
    centred = centred / size  # float32 then suffices to find the neighbours, whatever the cloud's unit and position
    centred = centred.masked_fill(centred.abs() < 1e-100, 0.0)  # its square would be 0
    squared = _mean_squared_distance(centred)
    if not bool(squared.all()):
        distinct, inverse, counts = centred.unique(dim=0, return_inverse=True, return_counts=True)
        if 2 * int((counts >= NEIGHBOURS).sum()) > len(distinct):
            squared = _mean_squared_distance(distinct).index_select(0, inverse)
    typical = squared[squared > 0].median()
    return 0.5 * squared.clamp(min=MIN_RELATIVE_SPACING**2 * typical).log() + size.log()


def _mean_squared_distance(points: Tensor) -> Tensor:
    """The mean squared distance to the nearest three points, or to all others where they are fewer, `(N,)`."""
    ids = _nearest(points, min(NEIGHBOURS + 1, len(points)))[:, 1:]  # the first is the point itself or its double
    return (points[ids] - points[:, None, :]).square().sum(dim=-1).mean(dim=-1)


def _nearest(points: Tensor, count: int) -> Tensor:
    """The nearest points of each point in float32, in order, `(N, count)`; without OpenCV in quadratic time."""
    data = points.float().cpu()
    try:
        import cv2
    except ModuleNotFoundError:
        blocks = data.split(max(1, _MAX_DISTANCES // len(data)))
        exact = "donot_use_mm_for_euclid_dist"
        found = [torch.cdist(x, data, compute_mode=exact).topk(count, largest=False).indices for x in blocks]
        return torch.cat(found).to(points.device)
    array = data.numpy()  # the index refers to this array, it makes no copy
    index = cv2.flann_Index(array, {"algorithm": 4})  # type: ignore[attr-defined]  # an exact k-d tree; not in the stubs
    nearest, _ = index.knnSearch(array, count, params={})
    return torch.from_numpy(nearest).long().to(points.device)
