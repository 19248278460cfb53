"""Compositing in torch: an autograd function that goes through row slices and depth slices, forward and backward.

One row slice is kept for the backward pass, several are made again there.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from kgs.covariance import footprint_table, moment_gradients
from kgs.full_precision import full_precision
from kgs.types import Composited, ProjectedGaussians, RasterOptions

from .tasks import Rules, Slice, buffer_bytes, choose_chunk_size
from .threads import run_all
from .tiles import Reach, TileLists, to_images, to_tiles
from .torch_steps import Backward, Forward

_LAYERS = 192  # entries per tile in a depth slice: few pixels see more before their light is gone
DepthSlices = list[tuple[tuple[int, int], Slice]]  # ranks, and what was done with them


def composite_torch(
    projected: ProjectedGaussians, features: Tensor, options: RasterOptions, median_depth: bool, chunk_size: int | None
) -> Composited:
    """`kgs.composite` in torch, for every device and dtype; trusts its arguments."""
    inputs = (projected.means2d, projected.factors, projected.opacities, features)
    keep = torch.is_grad_enabled() and any(x.requires_grad for x in inputs)
    buffers, number = buffer_bytes(options.max_bytes, features), features.element_size()
    budget = options.max_bytes - buffers * (4 if features.device.type == "cpu" else 1)  # some threads, one GPU
    # working memory of a Gaussian in a row of tiles; and in a tile: lists, sorting, gradients, their sum, saved light
    per_span, per_entry = 32 + 16 * number, 80 + (8 + 2 * features.shape[1] + options.tile_size**2 // 8) * number
    reach = Reach(projected, options.tile_size, options.alpha_threshold, max(2**12, budget // (2 * per_span)))
    slices = reach.row_slices(budget, per_span, per_entry)
    size = chunk_size or choose_chunk_size(reach)
    threads = max(4, options.max_bytes // 4 // max(1, buffers))
    rules = Rules(options.alpha_threshold, options.transmittance_stop, median_depth, size, buffers, threads)
    spare = budget - per_entry * reach.num_entries - per_span * reach.num_spans // 4
    passes = _Passes(projected, reach, slices, rules, spare if len(slices) == 1 else 0)
    sums, transmittance, median = _Composite.apply(*inputs, passes, keep)
    return Composited(sums, transmittance, median if median_depth else None)


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


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, factors: Tensor, opacities: Tensor, features: Tensor, passes: _Passes, keep: bool
    ) -> tuple[Tensor, ...]:
        inputs = (means2d, factors, opacities, features)
        keep_slice = keep and len(passes.row_slices) == 1
        with full_precision(means2d.device):
            parts, done = zip(*(passes.forward(inputs, rows, keep_slice) for rows in passes.row_slices), strict=True)
        ctx.save_for_backward(*inputs)
        ctx.passes, ctx.kept = passes, done[0] if keep_slice else None
        grid, size = passes.reach.grid, passes.projected.image_size
        images = tuple(to_images(torch.cat(x), grid, size) for x in zip(*parts, strict=True))
        ctx.mark_non_differentiable(images[2])
        return images

    @staticmethod
    def backward(ctx: Any, grad_sums: Tensor, grad_transmittance: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError("composite: expected backward without create_graph, there is no second derivative")
        passes, inputs, reach = ctx.passes, ctx.saved_tensors, ctx.passes.reach
        _, factors, opacities, _ = inputs
        grads, behind = (to_tiles(x, reach.grid, reach.tile_size) for x in (grad_sums, grad_transmittance))
        moments, width = any(ctx.needs_input_grad[:3]), grads.shape[1] if ctx.needs_input_grad[3] else 0
        total = factors.new_zeros(reach.ids.shape[0], 6 * moments + width)
        with full_precision(factors.device):
            for begin, end in passes.row_slices:
                done, ctx.kept = ctx.kept, None  # its memory is free after this; a second backward makes it again
                if done is None:
                    done = passes.forward(inputs, (begin, end), keep=True)[1]
                tiles = slice(begin * reach.grid[1], end * reach.grid[1])
                passes.backward(done, grads[tiles], behind[tiles], total, moments, width > 0)
                del done
        found: tuple[Tensor | None, ...] = (None, None, None, total[:, total.shape[1] - width :])
        if moments:
            used, opaque = (x.index_select(0, reach.ids) for x in (factors, opacities))
            found = (*moment_gradients(total[:, :6], used, opaque, passes.projected.eps2d), found[3])

        def of_all(value: Tensor) -> Tensor:
            return value.new_zeros(factors.shape[0], *value.shape[1:]).index_copy_(0, reach.ids, value)

        wanted = zip(found, ctx.needs_input_grad, strict=False)
        return *(of_all(x) if needed and x is not None else None for x, needed in wanted), None, None
