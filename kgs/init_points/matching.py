"""Matches keypoints along epipolar lines: mutual nearest neighbours among descriptors that pass the ratio test."""

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kgs.backends import takes_kernels

MAX_LINE_DISTANCE = 1.5  # pixels, from an epipolar line
CHUNK = 256  # keypoints matched at once: bounds the memory
MAX_RATIO = 0.8  # of the best descriptor distance to the second best
MAX_DISTANCE = 0.4  # between descriptors of length 1, for matches without a second candidate too


def match(
    lines: Tensor, pixels: Tensor, descriptors1: Tensor, descriptors2: Tensor, backend: str = "auto"
) -> tuple[Tensor, ...]:
    """Descriptor distances, and indices of the keypoints in the first and second view, each `(K,)`, of K matches.

    Args:
        lines: epipolar lines of the first view's keypoints in the second, normals of length 1, `(N, 3)`.
        pixels: of the second view's keypoints, `(M, 2)`.
        descriptors1: of length 1, `(N, F)`.
        descriptors2: `(M, F)`.
        backend: "numba" and "auto" use kernels if possible; the matches are the same.
    """
    if not takes_kernels(backend, "matching", lines):
        return _torch_matches(lines, pixels, descriptors1, descriptors2)
    from .matching_kernels import mutual_nearest

    arrays = (lines.numpy(), pixels.T.contiguous().numpy(), (descriptors1.numpy(), descriptors2.numpy()))
    matches = mutual_nearest(torch.get_num_threads(), *arrays, MAX_LINE_DISTANCE, MAX_RATIO, MAX_DISTANCE)
    return tuple(map(torch.from_numpy, matches))


def _torch_matches(lines: Tensor, pixels: Tensor, descriptors1: Tensor, descriptors2: Tensor) -> tuple[Tensor, ...]:
    """`match` in torch."""
    targets = convert_points_to_homogeneous(pixels).T
    candidates = [(torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64), torch.zeros(0))]
    for start in range(0, len(lines), CHUNK):
        rows, columns = ((lines[start : start + CHUNK] @ targets).abs_() < MAX_LINE_DISTANCE).nonzero().unbind(1)
        # One pair in about a hundred is left: a tenth of the work of all descriptor distances.
        differences = descriptors1.index_select(0, rows + start) - descriptors2.index_select(0, columns)
        candidates.append((rows + start, columns, differences.square_().sum(1).sqrt_()))
    rows, columns, distances = map(torch.cat, zip(*candidates, strict=True))
    nearest1, rival1 = _nearest(distances, rows, len(lines))
    nearest2, rival2 = _nearest(distances, columns, len(pixels))
    good = nearest1 & nearest2 & (distances < MAX_RATIO * torch.minimum(rival1, rival2)) & (distances < MAX_DISTANCE)
    return distances[good], rows[good], columns[good]


def _nearest(distances: Tensor, owners: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """For each candidate: whether it is its owner's nearest, and the distance of its owner's second nearest."""
    order = torch.arange(len(distances))
    infinite = distances.new_full((count,), torch.inf)
    ties = distances == infinite.scatter_reduce(0, owners, distances, "amin")[owners]
    first = order.new_full((count,), len(order)).scatter_reduce(0, owners[ties], order[ties], "amin")
    nearest = first[owners] == order
    rival = infinite.scatter_reduce(0, owners[~nearest], distances[~nearest], "amin")
    return nearest, rival[owners]
