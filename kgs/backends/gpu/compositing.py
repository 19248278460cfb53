"""Compositing by the kernels: lists, images, gradients."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kgs.backends.base import Inputs
from kgs.raster.binning import check_fits
from kgs.types import ProjectedGaussians, RasterOptions

from .binning_kernels import count_entries, fill_entries, fill_table
from .compositing_kernels import FEATURES, ROW, SIZE, K, composite_backward, composite_forward, sum_entries
from .launch import blocks, launch

_TINY = 2.0**-125  # smaller alphas and T are 0: products with them would be denormal
# bytes of an entry: tile and rank, both sorted, its place, memory of the sort; its share of T; its row of moments
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
class _Drawn:
    """A row slice after the forward pass; the tensors are those of `.compositing_kernels`."""

    entries: Tensor
    places: Tensor
    offsets: Tensor
    starts: Tensor
    reached: Tensor


class GpuCompositing:
    """Compositing of one call, see `kgs.backends.base.Compositor`; row slices where lists do not fit."""

    def __init__(
        self, projected: ProjectedGaussians, features: Tensor, options: RasterOptions, median_depth: bool
    ) -> None:
        """Sort by depth, and find the row slices that fit; reads one number for each that is tried."""
        fields = (projected.means2d, projected.factors, projected.opacities, projected.depths)
        means2d, factors, opacities, depths = (x.detach().contiguous() for x in fields)
        self._size, self._cameras, self._eps2d = projected.image_size, projected.num_cameras, projected.eps2d
        self._image_rows, self._columns = (blocks(length, SIZE) for length in self._size)
        self._features = range(0, max(features.shape[1], 1), FEATURES)  # where blocks of them begin
        self._median_depth, self._absgrad = median_depth, options.absgrad
        self._stops = tuple(max(x, _TINY) for x in (options.alpha_threshold, options.transmittance_stop))
        self._order = torch.argsort(depths, stable=True)
        self._table = depths.new_empty(len(projected), 8)
        footprints = (means2d, factors, opacities)
        arguments = (self._order, *footprints, depths, self._eps2d, len(projected), self._table)
        launch(fill_table, (blocks(len(projected), 128),), *arguments, BLOCK=128)
        log2_threshold = math.log2(options.alpha_threshold) if options.alpha_threshold else -math.inf
        ellipses = (self._order, *footprints, projected.camera_ids.contiguous(), self._eps2d, log2_threshold)
        self._ellipses = (*ellipses, *self._size, self._image_rows)
        self._slices = self._fitting(0, self._cameras * self._image_rows, options.max_bytes)

    def forward(self, inputs: Inputs, keep: bool) -> tuple[tuple[Tensor, Tensor, Tensor], Any]:
        """See `Compositor`: one row slice is kept, several are computed again."""
        features = inputs[3]
        widths = (features.shape[1], 1, 1 if self._median_depth else 0)
        images = [features.new_empty(self._cameras, width, *self._size) for width in widths]
        keep = keep and len(self._slices) == 1
        drawn = [self._draw(rows, features, images, keep) for rows in self._slices]
        return (images[0], images[1], images[2]), drawn[0] if keep else None

    def backward(
        self, inputs: Inputs, kept: Any, grad_features: Tensor, grad_transmittance: Tensor, needs: tuple[bool, ...]
    ) -> tuple[Tensor | None, ...]:
        """See `Compositor`."""
        features = inputs[3]
        n, channels = features.shape
        needs_absolute = self._absgrad and needs[0]
        found = [x.new_empty(x.shape) for x in inputs]
        absolute = found[0].new_empty(found[0].shape if needs_absolute else (0,))
        values = features.contiguous()
        factors, opacities, grads, behind = (x.contiguous() for x in (*inputs[1:3], grad_features, grad_transmittance))

        def add(rows: _Rows, drawn: _Drawn) -> None:
            """Add the gradients of a row slice; what it needs is freed before the next is drawn."""
            later_slice = rows is not self._slices[0]
            lists = (drawn.entries, drawn.places, drawn.offsets, *self._tiles(rows), channels, *self._stops)
            given = (self._table, values, self._order, *lists, drawn.starts, drawn.reached, grads, behind)
            moments, tiles = features.new_zeros(rows.entries, ROW), (len(drawn.reached),)
            for first in self._features:
                launch(composite_backward, tiles, *given, first, moments, ABSOLUTE=needs_absolute, warps=1)
                launch(
                    sum_entries,
                    (blocks(n, 8),),
                    *(self._order, rows.begins, moments, factors, opacities, self._eps2d, n, channels, first),
                    *(*found, absolute),
                    MOMENTS=any(needs[:3]),
                    WITH_FEATURES=needs[3],
                    ABSOLUTE=needs_absolute,
                    ADD=later_slice or first > 0,
                    ADD_FEATURES=later_slice,
                    BLOCK=8,
                    STRIDE=16,
                )

        for rows in self._slices:
            add(rows, self._draw(rows, features, None, True) if kept is None else kept)
            kept = None
        wanted = (x if needed else None for x, needed in zip(found, needs, strict=True))
        return *wanted, absolute if needs_absolute else None

    def _fitting(self, begin: int, end: int, max_bytes: int) -> list[_Rows]:
        """Row slices of the rows `begin` to `end` whose lists take at most `max_bytes`: halves, where they do not."""
        n = len(self._order)
        counts = self._order.new_empty(n, dtype=torch.int32)
        launch(count_entries, (blocks(n, _LANES),), *self._ellipses, begin, end, n, counts, BLOCK=_LANES, warps=1)
        begins = self._order.new_zeros(n + 1)
        torch.cumsum(counts, 0, out=begins[1:])
        entries = int(begins[-1])
        need = entries * _PER_ENTRY + (end - begin) * self._columns * SIZE * SIZE * 4
        if need > max_bytes and end - begin > 1:
            middle = (begin + end) // 2
            del counts, begins
            return self._fitting(begin, middle, max_bytes) + self._fitting(middle, end, max_bytes)
        check_fits(need, max_bytes)
        return [_Rows(begin, end, begins, entries)]

    def _tiles(self, rows: _Rows) -> tuple[int, ...]:
        """How the tiles of a row slice lie in the images."""
        return (rows.begin * self._columns, self._columns, self._image_rows, *self._size)

    def _draw(self, rows: _Rows, features: Tensor, images: list[Tensor] | None, keep: bool) -> _Drawn:
        """Fill sums, transmittance and median depth; without images only compute what `backward` needs again."""
        n, tiles = len(self._order), (rows.end - rows.begin) * self._columns
        kind = torch.int16 if tiles < 2**15 else torch.int32  # sorted in half the time
        keys = self._order.new_full((rows.entries,), tiles, dtype=kind)  # behind all tiles
        ranks = self._order.new_empty(rows.entries, dtype=torch.int32)
        where = (rows.begin, rows.end, n, self._columns, rows.begins, keys, ranks)  # as many as were counted, or fewer
        launch(fill_entries, (blocks(n, _LANES),), *self._ellipses, *where, BLOCK=_LANES, warps=1)
        keys, places = torch.sort(keys, stable=True)
        offsets = torch.searchsorted(keys, torch.arange(tiles + 1, dtype=kind, device=keys.device))
        entries = ranks.index_select(0, places)
        chunks = rows.entries // K + tiles if keep else 0
        starts = features.new_empty(chunks, SIZE * SIZE)
        reached = self._order.new_empty(tiles, dtype=torch.int32)
        rest = (*self._tiles(rows), features.shape[1], *self._stops, starts, reached)
        launch(
            composite_forward,
            (tiles, len(self._features) if images else 1),
            *(self._table, features.contiguous(), self._order, entries, offsets, *rest, *(images or [starts] * 3)),
            KEEP=keep,
            DRAW=images is not None,
            MEDIAN=images is not None and self._median_depth,
            warps=1,
        )
        return _Drawn(entries, places, offsets, starts, reached)
