"""Compositing by the kernels: lists, images, gradients."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kgs.backends.base import CompositingCall, CompositingInputs, Compositor, Images
from kgs.backends.row_slices import check_fits

from .binning_kernels import count_entries, fill_entries, fill_table
from .compositing_kernels import FEATURES, ROW, SIZE, K, composite_backward, composite_forward, sum_entries
from .launch import blocks, launch

_TINY = 2.0**-125  # smaller alphas and T are 0: products with them would be denormal
# bytes of an entry: tile and rank, both sorted, its slot, memory of the sort; its share of T; its row of moments
_PER_ENTRY = 4 * (2 + 2 + 2 + 4 + SIZE * SIZE // K + ROW)
_LANES = 32  # Gaussians of a program that goes through their tiles


@dataclass(frozen=True)
class _Rows:
    """A row slice: rows of tiles, numbered through all cameras, and where the entries of each Gaussian begin."""

    begin: int
    end: int
    begins: Tensor
    entries: int


@dataclass(frozen=True)
class _Lists:
    """The lists of a row slice, and what its forward pass left; the tensors are those of `.compositing_kernels`."""

    entries: Tensor
    slots: Tensor
    offsets: Tensor
    starts: Tensor
    reached: Tensor


class GpuCompositor(Compositor):
    """Compositing of one call; its constructor reads one number for each row slice that it tries."""

    def __init__(self, call: CompositingCall) -> None:
        projected = call.projected
        options = call.options
        fields = (projected.means2d, projected.factors, projected.opacities, projected.depths)
        means2d, factors, opacities, depths = (x.detach().contiguous() for x in fields)
        self._size = projected.image_size
        self._cameras = projected.num_cameras
        self._eps2d = projected.eps2d
        self._image_rows, self._columns = (blocks(length, SIZE) for length in self._size)
        self._features = range(0, max(call.features.shape[1], 1), FEATURES)  # where blocks of them begin
        self._median_depth = call.median_depth
        self._absgrad = options.absgrad
        self._thresholds = (max(options.alpha_threshold, _TINY), max(options.transmittance_stop, _TINY))
        self._order = torch.argsort(depths, stable=True)
        self._table = depths.new_empty(len(projected), 8)
        footprints = (means2d, factors, opacities)
        arguments = (self._order, *footprints, depths, self._eps2d, len(projected), self._table)
        launch(fill_table, (blocks(len(projected), 128),), *arguments, BLOCK=128)
        log2_threshold = math.log2(options.alpha_threshold) if options.alpha_threshold else -math.inf
        ellipses = (self._order, *footprints, projected.camera_ids.contiguous(), self._eps2d, log2_threshold)
        self._ellipses = (*ellipses, *self._size, self._image_rows)
        self._slices = self._fitting(0, self._cameras * self._image_rows, options.max_bytes)

    def forward(self, inputs: CompositingInputs, keep: bool) -> tuple[Images, Any]:
        """See `Compositor`. One row slice is kept, several are computed again."""
        features = inputs.features
        widths = (features.shape[1], 1, 1 if self._median_depth else 0)
        images = [features.new_empty(self._cameras, width, *self._size) for width in widths]
        keep = keep and len(self._slices) == 1
        lists = [self._composite_rows(rows, features, images, keep) for rows in self._slices]
        return (images[0], images[1], images[2]), lists[0] if keep else None

    def backward(
        self,
        inputs: CompositingInputs,
        kept: Any,
        grad_features: Tensor,
        grad_transmittance: Tensor,
        needs: tuple[bool, ...],
    ) -> tuple[tuple[Tensor | None, ...], Tensor | None]:
        """See `Compositor`."""
        features = inputs.features.contiguous()
        n, channels = features.shape
        needs_absolute = self._absgrad and needs[0]
        input_grads = [x.new_empty(x.shape) for x in inputs]
        absolute = features.new_empty((n, 2) if needs_absolute else (0,))
        factors = inputs.factors.contiguous()
        opacities = inputs.opacities.contiguous()
        grads = grad_features.contiguous()
        behind = grad_transmittance.contiguous()

        def add(rows: _Rows, lists: _Lists) -> None:
            """Add the gradients of a row slice; what it needs is freed before the next is made."""
            later_slice = rows is not self._slices[0]
            tiles = (lists.entries, lists.slots, lists.offsets, *self._tiles(rows), channels, *self._thresholds)
            given = (self._table, features, self._order, *tiles, lists.starts, lists.reached, grads, behind)
            moments = features.new_zeros(rows.entries, ROW)
            for first in self._features:
                grid = (len(lists.reached),)
                launch(composite_backward, grid, *given, first, moments, ABSOLUTE=needs_absolute, warps=1)
                launch(
                    sum_entries,
                    (blocks(n, 8),),
                    *(self._order, rows.begins, moments, factors, opacities, self._eps2d, n, channels, first),
                    *(*input_grads, absolute),
                    MOMENTS=any(needs[:3]),
                    WITH_FEATURES=needs[3],
                    ABSOLUTE=needs_absolute,
                    ADD=later_slice or first > 0,
                    ADD_FEATURES=later_slice,
                    BLOCK=8,
                    STRIDE=16,
                )

        for rows in self._slices:
            add(rows, self._composite_rows(rows, features, None, True) if kept is None else kept)
            kept = None
        gradients = tuple(x if need else None for x, need in zip(input_grads, needs, strict=True))
        return gradients, absolute if needs_absolute else None

    def _fitting(self, begin: int, end: int, max_bytes: int) -> list[_Rows]:
        """Row slices of the rows `begin` to `end` whose lists take at most `max_bytes`: halves, where they do not."""
        n = len(self._order)
        counts = self._order.new_empty(n, dtype=torch.int32)
        launch(count_entries, (blocks(n, _LANES),), *self._ellipses, begin, end, n, counts, BLOCK=_LANES, warps=1)
        begins = self._order.new_zeros(n + 1)
        torch.cumsum(counts, 0, out=begins[1:])
        entries = int(begins[-1])
        size = entries * _PER_ENTRY + (end - begin) * self._columns * SIZE * SIZE * 4
        if size > max_bytes and end - begin > 1:
            middle = (begin + end) // 2
            del counts, begins
            return self._fitting(begin, middle, max_bytes) + self._fitting(middle, end, max_bytes)
        check_fits(size, max_bytes)
        return [_Rows(begin, end, begins, entries)]

    def _tiles(self, rows: _Rows) -> tuple[int, ...]:
        """How the tiles of a row slice lie in the images."""
        return (rows.begin * self._columns, self._columns, self._image_rows, *self._size)

    def _composite_rows(self, rows: _Rows, features: Tensor, images: list[Tensor] | None, keep: bool) -> _Lists:
        """Fill sums, transmittance and median depth; without images only compute what `backward` needs again."""
        n = len(self._order)
        tiles = (rows.end - rows.begin) * self._columns
        kind = torch.int16 if tiles < 2**15 else torch.int32  # sorted in half the time
        keys = self._order.new_full((rows.entries,), tiles, dtype=kind)  # behind all tiles
        ranks = self._order.new_empty(rows.entries, dtype=torch.int32)
        where = (rows.begin, rows.end, n, self._columns, rows.begins, keys, ranks)  # as many as were counted, or fewer
        launch(fill_entries, (blocks(n, _LANES),), *self._ellipses, *where, BLOCK=_LANES, warps=1)
        keys, slots = torch.sort(keys, stable=True)
        offsets = torch.searchsorted(keys, torch.arange(tiles + 1, dtype=kind, device=keys.device))
        entries = ranks.index_select(0, slots)
        chunks = rows.entries // K + tiles if keep else 0
        starts = features.new_empty(chunks, SIZE * SIZE)
        reached = self._order.new_empty(tiles, dtype=torch.int32)
        rest = (*self._tiles(rows), features.shape[1], *self._thresholds, starts, reached)
        launch(
            composite_forward,
            (tiles, len(self._features) if images else 1),
            *(self._table, features.contiguous(), self._order, entries, offsets, *rest, *(images or [starts] * 3)),
            KEEP=keep,
            IMAGES=images is not None,
            MEDIAN=images is not None and self._median_depth,
            warps=1,
        )
        return _Lists(entries, slots, offsets, starts, reached)
