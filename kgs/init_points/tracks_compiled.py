"""The matching of keypoints on `kgs.compiled.matching`."""

import torch
from torch import Tensor

from kgs.compiled.matching import mutual_nearest

from .tracks import MAX_DISTANCE, MAX_LINE_DISTANCE, MAX_RATIO


def compiled_matches(lines: Tensor, places: Tensor, descriptors1: Tensor, descriptors2: Tensor) -> tuple[Tensor, ...]:
    """The stage "matching"."""
    arrays = (lines.numpy(), places.T.contiguous().numpy(), (descriptors1.numpy(), descriptors2.numpy()))
    found = mutual_nearest(torch.get_num_threads(), *arrays, MAX_LINE_DISTANCE, MAX_RATIO, MAX_DISTANCE)
    return tuple(map(torch.from_numpy, found))
