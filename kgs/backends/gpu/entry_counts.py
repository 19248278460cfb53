"""The entries of what was projected, counted by the projection, so that compositing need not wait for their number."""

import math
from typing import NamedTuple
from weakref import WeakKeyDictionary

from torch import Tensor

from kgs.geometry.types import ProjectedGaussians


class EntryCounts(NamedTuple):
    """How many tiles each projected Gaussian of one camera reaches.

    They belong to the object that was projected, as long as its tensors are not changed in place. (What changes
    `tensor.data` is not seen, as by autograd.)

    Args:
        counts: `(M,)` int32, in the order of the Gaussians.
        entries: their sum.
        alpha_threshold: what they were counted for.
        versions: of the tensors that they were counted of.
    """

    counts: Tensor
    entries: int
    alpha_threshold: float
    versions: tuple[int, ...]


_known: WeakKeyDictionary[ProjectedGaussians, EntryCounts] = WeakKeyDictionary()


def log2_threshold(alpha_threshold: float) -> float:
    """As the kernels take it."""
    return math.log2(alpha_threshold) if alpha_threshold else -math.inf


def remember(projected: ProjectedGaussians, alpha_threshold: float, counts: Tensor, entries: int) -> None:
    """Keep the counts while `projected` lives; not in inference mode, where no tensor knows its version."""
    if not projected.means2d.is_inference():
        _known[projected] = EntryCounts(counts, entries, alpha_threshold, _versions(projected))


def find(projected: ProjectedGaussians, alpha_threshold: float) -> EntryCounts | None:
    """The counts of these Gaussians, if they are known."""
    found = _known.get(projected)
    if found is None or found.alpha_threshold != alpha_threshold or found.versions != _versions(projected):
        return None
    return found


def _versions(projected: ProjectedGaussians) -> tuple[int, ...]:
    return projected.means2d._version, projected.factors._version, projected.opacities._version
