"""Compositing by the kernels of `kgs.compiled`: an autograd function that goes through row slices and bands.

One row slice is kept for the backward pass, several are made again there.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kgs.compiled import compositing as kernels
from kgs.compiled.bands import Band, Reach, RowSlice
from kgs.compiled.threads import over
from kgs.types import Composited, ProjectedGaussians, RasterOptions

from .tiles import row_slices

_NUMBER = 4  # bytes
Floats = NDArray[np.float32]


def composite_compiled(
    projected: ProjectedGaussians, features: Tensor, options: RasterOptions, median_depth: bool, _: int | None
) -> Composited:
    """`kgs.composite` for float32 on a CPU and tiles of 8 x 8 pixels; trusts its arguments."""
    inputs = (projected.means2d, projected.factors, projected.opacities, features)
    keep = torch.is_grad_enabled() and any(x.requires_grad for x in inputs)
    passes = _Passes.plan(projected, features, options, median_depth)
    sums, light, median = _Composite.apply(*inputs, passes, keep)
    return Composited(sums, light, median if median_depth else None)


@dataclass(frozen=True)
class _Done:
    """A band after the forward pass: its lists, T at the beginning of each chunk, how many entries were reached."""

    band: Band
    starts: Floats
    done: NDArray[np.int64]


@dataclass(frozen=True)
class _Passes:
    """Both passes over a row slice, its bands on several threads."""

    reach: Reach
    row_slices: list[tuple[int, int]]
    image_shape: tuple[int, int, int]  # (C, H, W)
    blocks: list[tuple[int, int]]  # of features: where each begins, and its width
    median_depth: bool
    threshold: np.float32
    stop: np.float32
    eps2d: np.float32

    @classmethod
    def plan(
        cls, projected: ProjectedGaussians, features: Tensor, options: RasterOptions, median_depth: bool
    ) -> "_Passes":
        """Find what each Gaussian reaches, and the row slices that fit."""
        blocks = _blocks(features.shape[1])
        channels = sum(width for _, width in blocks)
        # a span, and at most one member for it: number, row of the table, sums; an entry, and its share of kept T
        per_span = _NUMBER * (1 + 1 + 7 + channels + median_depth + 6 + channels)
        per_entry = _NUMBER * (1 + kernels.P // kernels.K)
        inputs = (projected.means2d, projected.factors, projected.opacities, features)
        arrays = _arrays(*inputs, projected.depths, projected.camera_ids)
        rules = np.float32(projected.eps2d), np.float32(options.alpha_threshold)
        most, size = max(2**12, options.max_bytes // (2 * per_span)), projected.image_size
        cameras, threads = projected.num_cameras, torch.get_num_threads()
        reach = Reach(arrays, size, cameras, rules, channels, median_depth, most, threads)
        needs = reach.spans_per_row * per_span + reach.entries_per_row * per_entry
        slices = row_slices(needs.tolist(), options.max_bytes)
        threshold, stop = (
            np.float32(max(x, kernels.TINY)) for x in (options.alpha_threshold, options.transmittance_stop)
        )
        return cls(reach, slices, (cameras, *size), blocks, median_depth, threshold, stop, rules[0])

    def forward(self, rows: tuple[int, int], outputs: tuple[Floats, ...], keep: bool) -> tuple[RowSlice, list[_Done]]:
        """Fill light, median depth and sums; without sums only what `backward` wants is made again."""
        part, (light, median, sums) = self.reach.row_slice(*rows), outputs
        count = len(part.bounds) - 1
        done: list[_Done] = [None] * count  # type: ignore[list-item]
        rules = (self.threshold, self.stop)

        def work(begin: int, end: int) -> None:
            for b in range(begin, end):
                band = self.reach.band(part, b)
                tiles = len(band.offsets) - 1
                chunks = len(band.entries) // kernels.K + tiles if keep else 0
                starts, reached = np.empty((chunks, kernels.P), np.float32), np.empty(tiles, np.int64)
                lists = (band.first_tile, self.reach.grid, band.offsets, band.entries, band.table, *rules)
                for first, width in self.blocks if len(sums) else self.blocks[:1]:
                    rest = (starts, reached, light, median, sums)
                    kernels.composite_forward(*lists, first, (0,) * width, *rest)
                if keep:
                    done[b] = _Done(band, starts, reached)

        over(torch.get_num_threads(), count, work, pieces=count)
        return part, done

    def backward(
        self, part: RowSlice, done: list[_Done], grads: Floats, grad_light: Floats, totals: Floats, wanted: Any
    ) -> None:
        """Add to `totals` what each Gaussian gets: six moments and dL/d features, `(n, 6 + F)`."""
        sums = np.zeros((len(part.members), totals.shape[1]), np.float32)

        def work(begin: int, end: int) -> None:
            for own in done[begin:end]:
                band = own.band
                lists = (band.first_tile, self.reach.grid, band.offsets, band.entries, band.table)
                for first, width in self.blocks:
                    rest = (own.starts, own.done, grads, grad_light, *wanted, sums[band.members])
                    kernels.composite_backward(*lists, self.threshold, self.stop, first, (0,) * width, *rest)

        threads = torch.get_num_threads()
        over(threads, len(done), work, pieces=len(done))
        over(threads, len(totals), kernels.add_members, part.offsets, part.members, sums, totals)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, factors: Tensor, opacities: Tensor, features: Tensor, passes: _Passes, keep: bool
    ) -> tuple[Tensor, ...]:
        cameras, *size = passes.image_shape
        widths = (1, 1 if passes.median_depth else 0, features.shape[1])
        light, median, sums = (features.new_empty(cameras, width, *size) for width in widths)
        outputs = (light[:, 0].numpy(), median[:, 0].numpy() if passes.median_depth else _nothing(3), sums.numpy())
        keep_slice = keep and len(passes.row_slices) == 1
        done = [passes.forward(rows, outputs, keep_slice) for rows in passes.row_slices]
        ctx.save_for_backward(means2d, factors, opacities, features)
        ctx.passes, ctx.kept = passes, done[0] if keep_slice else None
        ctx.mark_non_differentiable(median)
        return sums, light, median

    @staticmethod
    def backward(ctx: Any, grad_sums: Tensor, grad_light: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError("composite: expected backward without create_graph, there is no second derivative")
        passes, inputs = ctx.passes, ctx.saved_tensors
        moments, colors = any(ctx.needs_input_grad[:3]), ctx.needs_input_grad[3]
        grads, behind = _arrays(grad_sums, grad_light[:, 0])
        totals = np.zeros((len(passes.reach.ids), passes.reach.table.shape[1] - 1 - passes.median_depth), np.float32)
        blank = (np.empty_like(behind), _nothing(3), _nothing(4))
        for rows in passes.row_slices:
            done, ctx.kept = ctx.kept, None  # its memory is free after this; a second backward makes it again
            passes.backward(*(done or passes.forward(rows, blank, True)), grads, behind, totals, (moments, colors))
            del done
        wanted = (*[moments] * 3, colors)
        found = [x.new_empty(x.shape if need else (0, *x.shape[1:])) for x, need in zip(inputs, wanted, strict=True)]
        own = _arrays(*inputs[1:3])
        rest = (passes.reach.ranks, totals, *own, passes.eps2d, *_arrays(*found))
        over(torch.get_num_threads(), len(inputs[0]), kernels.fill_gradients, *rest)
        return *(x if need else None for x, need in zip(found, ctx.needs_input_grad, strict=False)), None, None


def _blocks(features: int) -> list[tuple[int, int]]:
    """Where blocks of features begin, and how many each has: what kernels are compiled for, the last padded."""
    most = kernels.WIDTHS[-1]
    begins = range(0, max(features, 1), most)
    return [(begin, next(w for w in kernels.WIDTHS if w >= min(features - begin, most))) for begin in begins]


def _arrays(*tensors: Tensor) -> list[NDArray[Any]]:
    """The memory of tensors, contiguous."""
    return [x.detach().contiguous().numpy() for x in tensors]


def _nothing(dimensions: int) -> Floats:
    return np.empty((0,) * dimensions, np.float32)
