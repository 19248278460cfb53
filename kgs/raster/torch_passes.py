"""Compositing in torch: an autograd function that goes through row slices and depth slices, forward and backward.

One row slice is kept for the backward pass, several are made again there.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from kgs.covariance import footprint_table
from kgs.types import ProjectedGaussians

from .tasks import Rules, Slice
from .threads import run_all
from .tiles import Reach, TileLists
from .torch_steps import Backward, Forward

_LAYERS = 192  # entries per tile in a depth slice: few pixels see more before their light is gone
DepthSlices = list[tuple[tuple[int, int], Slice]]  # ranks, and what was done with them


@dataclass(frozen=True)
class _Passes:
    """Both passes over a row slice: one depth slice after the other, nearest first, while light is left."""

    projected: ProjectedGaussians
    reach: Reach
    row_slices: list[tuple[int, int]]
    rules: Rules
    spare: int  # bytes to keep alphas for the backward pass

    def forward(self, inputs: tuple[Tensor, ...], rows: tuple[int, int], keep: bool) -> tuple[Any, DepthSlices]:
        """Sums, transmittance and median depth of the tiles, `(T, _, P)`; and what `backward` wants."""
        spans, spare, live = self.reach.spans(*rows), self.spare, None
        sums: tuple[Tensor, ...] = ()
        done: DepthSlices = []
        for ranks in self.reach.depth_slices(_LAYERS):
            part = self._slice(inputs, self.reach.lists(spans, *rows, ranks, live))
            sums = sums or part.blank()
            keep_alphas = keep and part.alpha_bytes <= spare
            spare -= part.alpha_bytes * keep_alphas
            run_all(part.groups, partial(Forward, part, sums, keep, keep_alphas), spans.rows.device, self.rules.threads)
            if keep:
                done.append((ranks, part))
            live = sums[0].amax((1, 2)) > 0
            if ranks[1] < self.reach.ids.shape[0] and not bool(live.any()):
                break
        transmittance, median, *features = sums
        return (torch.cat(features, 1), transmittance, median), done

    def backward(
        self, done: DepthSlices, grads: Tensor, behind: Tensor, total: Tensor, moments: bool, features: bool
    ) -> None:
        """Add to `total` what each Gaussian gets: six moments of dL/d ln alpha about its centre, and dL/d features.

        `grads` are dL/d sums, `(T, F, P)`; `behind` is V behind the last layer, `(T, 1, P)`, see `kgs.raster`, and used
        up; `total` is `(n, 6 + F)`, without the columns that are not wanted.
        """
        for (low, high), part in reversed(done):
            lists, entries = part.lists, part.lists.entries.shape[0]
            if entries == 0:
                continue
            rows = total.new_zeros(entries + 1, total.shape[1])
            make = partial(Backward, part, grads, behind, rows, moments, features)
            run_all(part.groups, make, rows.device, self.rules.threads)
            # each entry once, in the order of the Gaussians: a sum in fixed order, without atomics
            total[low:high] += F.embedding_bag(lists.by_gaussian, rows, lists.gaussian_offsets, mode="sum")

    def _slice(self, inputs: tuple[Tensor, ...], lists: TileLists) -> Slice:
        """A slice with what its steps need of each Gaussian, and a dummy at the end that has no effect."""
        means2d, factors, opacities, features = (x.index_select(0, lists.ids) for x in inputs)
        table = F.pad(footprint_table(means2d, factors, opacities, self.projected.eps2d), (0, 1))
        table[0, -1] = -torch.inf
        depths = self.projected.depths.detach() if self.rules.median_depth else None
        depths = None if depths is None else F.pad(depths.index_select(0, lists.ids), (0, 1))
        return Slice(table, F.pad(features, (0, 0, 0, 1)), depths, lists, self.rules)
