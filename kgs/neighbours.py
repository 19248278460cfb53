"""How far apart the points of a cloud are: the scale of Gaussians that start there."""

import math

import torch
from torch import Tensor

NEIGHBOURS = 3
MIN_RELATIVE_SPACING = 1e-3


def log_spacing(points: Tensor) -> Tensor:
    """Logarithm of the root mean squared distance to the three nearest points, float64 `(N,)`.

    It is at least a thousandth of the cloud's median one, as points may coincide. Where points coincide by fours and
    more than half of the places hold three or more (triangles of an STL), distances are those between places.

    Args:
        points: `(N, 3)`, N >= 4, finite, not all in one place; else a ValueError.
    """
    if len(points) <= NEIGHBOURS:
        raise ValueError(f"points: expected at least {NEIGHBOURS + 1} to take a spacing from, got {len(points)}")
    points = points.double()
    centred = points - points.mean(dim=0)
    size = centred.abs().amax()
    if not 0.0 < float(size) < math.inf:
        raise ValueError(f"points: expected points in different places, got a cloud of half size {float(size):g}")
    centred = centred / size  # float32 is then enough to find the neighbours, in whatever unit and place the cloud is
    centred = centred.masked_fill(centred.abs() < 1e-100, 0.0)  # its square would be 0
    squared = _mean_squared(centred)
    if not bool(squared.all()):
        places, inverse, counts = centred.unique(dim=0, return_inverse=True, return_counts=True)
        if 2 * int((counts >= NEIGHBOURS).sum()) > len(places):
            squared = _mean_squared(places).index_select(0, inverse)
    typical = squared[squared > 0].median()
    return 0.5 * squared.clamp(min=MIN_RELATIVE_SPACING**2 * typical).log() + size.log()


def _mean_squared(points: Tensor) -> Tensor:
    """The mean of the squared distances to the nearest three points, or to all others where they are fewer, `(N,)`."""
    import cv2

    data = points.float().cpu().numpy()  # the index refers to this array, it makes no copy
    index = cv2.flann_Index(data, {"algorithm": 4})  # type: ignore[attr-defined]  # an exact k-d tree; not in the stubs
    found, _ = index.knnSearch(data, min(NEIGHBOURS + 1, len(data)), params={})
    ids = torch.from_numpy(found[:, 1:]).long().to(points.device)  # the first is the point itself or its double
    return (points[ids] - points[:, None, :]).square().sum(dim=-1).mean(dim=-1)
