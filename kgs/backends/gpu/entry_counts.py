"""The entries of what was projected, counted by the projection, so that compositing need not wait for their number."""

import math
import weakref
from dataclasses import dataclass

from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from kgs.types import ProjectedGaussians


@dataclass(frozen=True)
class EntryCounts:
    """How many tiles each projected Gaussian of one camera reaches.

    They belong to the very tensors that were projected, as long as these are not changed in place. (What changes
    `tensor.data` is not seen, as by autograd.)

    Args:
        counts: `(M,)` int32, in the order of the Gaussians.
        entries: their sum.
        alpha_threshold: what they were counted for.
        tensors: what they were counted of, and its version.
        constants: image size, number of cameras and eps2d.
    """

    counts: Tensor
    entries: int
    alpha_threshold: float
    tensors: tuple[tuple["weakref.ref[Tensor]", int], ...]
    constants: tuple[object, ...]


_known = WeakTensorKeyDictionary()  # by means2d


def log2_threshold(alpha_threshold: float) -> float:
    """As the kernels take it."""
    return math.log2(alpha_threshold) if alpha_threshold else -math.inf


def remember(projected: ProjectedGaussians, alpha_threshold: float, counts: Tensor, entries: int) -> None:
    """Keep the counts while `projected.means2d` lives; not in inference mode, where no tensor knows its version."""
    tensors = _source_tensors(projected)
    if any(x.is_inference() for x in tensors):
        return
    versions = tuple((weakref.ref(x), x._version) for x in tensors)
    found = EntryCounts(counts, entries, alpha_threshold, versions, _constants(projected))
    _known[projected.means2d] = found


def find(projected: ProjectedGaussians, alpha_threshold: float) -> EntryCounts | None:
    """The counts of these Gaussians, if they are known."""
    found: EntryCounts | None = _known.get(projected.means2d)
    if found is None or found.alpha_threshold != alpha_threshold or found.constants != _constants(projected):
        return None
    pairs = zip(found.tensors, _source_tensors(projected), strict=True)
    return found if all(of() is x and version == x._version for (of, version), x in pairs) else None


def _source_tensors(projected: ProjectedGaussians) -> tuple[Tensor, ...]:
    return projected.means2d, projected.factors, projected.opacities


def _constants(projected: ProjectedGaussians) -> tuple[object, ...]:
    return tuple(projected.image_size), projected.num_cameras, projected.eps2d
