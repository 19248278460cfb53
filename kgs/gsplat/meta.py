"""gsplat's dict of intermediate results, packed or dense."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kgs.geometry.covariance import conics, reach, variances
from kgs.geometry.types import ProjectedGaussians

_LARGEST_RADIUS = 2e9  # pixels, as an int32


class Pairs:
    """The visible pairs (camera, Gaussian), and the layout of their values in gsplat's tensors.

    Packed: one after the other, `(M, ...)`. Dense: `(C, N, ...)`, 0 for pairs that are not visible.
    """

    def __init__(self, projected: ProjectedGaussians, count: int, n: int, packed: bool) -> None:
        self.projected = projected
        self.packed = packed
        self.shape = (count, n)
        self.ids = projected.camera_ids * n + projected.gaussian_ids

    def spread(self, values: Tensor) -> Tensor:
        """Values of the pairs, `(M, ...)`, in gsplat's layout."""
        if self.packed:
            return values
        count, n = self.shape
        dense = values.new_zeros(count * n, *values.shape[1:]).index_copy(0, self.ids, values)
        return dense.view(count, n, *values.shape[1:])

    def gathered(self, tensor: Tensor) -> Tensor:
        """The inverse of `spread`: the rows of the pairs."""
        return tensor if self.packed else tensor.flatten(0, 1).index_select(0, self.ids)

    def absgrad_hook(self, means2d: Tensor) -> Callable[[Tensor], None]:
        """A hook that stores absolute gradients as gsplat does: in `means2d.absgrad`."""

        def store(absolute: Tensor) -> None:
            means2d.absgrad = self.spread(absolute)  # type: ignore[attr-defined]

        return store

    def meta(self, means2d: Tensor) -> dict[str, Any]:
        """The entries of gsplat's dict that describe the pairs."""
        seen = self.projected
        xx, xy, yy, det = variances(seen.factors, seen.eps2d)
        ids = {
            "batch_ids": torch.zeros_like(seen.camera_ids),
            "camera_ids": seen.camera_ids,
            "gaussian_ids": seen.gaussian_ids,
        }
        return {
            "means2d": means2d,
            "depths": self.spread(seen.depths),
            "opacities": self.spread(seen.opacities),
            "conics": self.spread(conics(xx, xy, yy, det)),
            "radii": self.spread(reach(xx.detach(), yy.detach()).clamp_max(_LARGEST_RADIUS).int()),
            **(ids if self.packed else dict.fromkeys(ids)),
            "n_batches": 1,
            "n_cameras": self.shape[0],
        }
