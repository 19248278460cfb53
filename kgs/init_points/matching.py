"""Matches keypoints along epipolar lines: mutual nearest neighbours among descriptors that pass the ratio test."""

import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kgs.backends import Backend

MAX_LINE_DISTANCE = 1.5  # pixels, from an epipolar line
MAX_RATIO = 0.8  # of the best descriptor distance to the second best
MAX_DISTANCE = 0.4  # between descriptors of length 1, for matches without a second candidate too


def match(
    lines: Tensor, pixels: Tensor, descriptors1: Tensor, descriptors2: Tensor, backend: Backend
) -> tuple[Tensor, ...]:
    """Descriptor distances, and indices of the keypoints in the first and second view, each `(K,)`, of K matches.

    Args:
        lines: epipolar lines of the first view's keypoints in the second, normals of length 1, `(N, 3)`.
        pixels: of the second view's keypoints, `(M, 2)`.
        descriptors1: of length 1, `(N, F)`.
        descriptors2: `(M, F)`.
        backend: by numba's kernels or by torch; the matches are the same.
    """
    if backend.covering("matching", lines).name != "numba":
        return _torch_matches(lines, pixels, descriptors1, descriptors2)
    from .matching_kernels import mutual_nearest

    arrays = (lines.numpy(), pixels.T.contiguous().numpy(), (descriptors1.numpy(), descriptors2.numpy()))
    matches = mutual_nearest(torch.get_num_threads(), *arrays, MAX_LINE_DISTANCE, MAX_RATIO, MAX_DISTANCE)
    return tuple(map(torch.from_numpy, matches))


def _torch_matches(lines: Tensor, pixels: Tensor, descriptors1: Tensor, descriptors2: Tensor) -> tuple[Tensor, ...]:
    """`match` in torch."""
    targets = convert_points_to_homogeneous(pixels).T
    distances = descriptors1.new_full((len(lines) + 1, len(pixels) + 1), torch.inf)  # one more: there may be none
    for row, line in enumerate(lines):
        columns = ((line @ targets).abs() < MAX_LINE_DISTANCE).nonzero()[:, 0]  # of about one in a hundred
        distances[row, columns] = (descriptors1[row] - descriptors2[columns]).square().sum(1).sqrt()
    nearest = distances.argmin(1)
    rows = (distances.argmin(0)[nearest] == torch.arange(len(nearest))).nonzero()[:, 0]
    columns = nearest[rows]
    best = distances[rows, columns]
    distances[rows, columns] = torch.inf
    rivals = torch.minimum(distances.amin(1)[rows], distances.amin(0)[columns])
    good = (best < MAX_RATIO * rivals) & (best < MAX_DISTANCE)
    return best[good], rows[good], columns[good]
