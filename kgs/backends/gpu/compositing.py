"""Compositing by the kernels: lists, images, gradients."""

from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from kgs.backends.row_slices import check_fits, default_max_bytes
from kgs.backends.signatures import Compositor, Images, Inputs
from kgs.geometry.types import ProjectedGaussians, RasterOptions

from . import entry_counts
from .binning_kernels import count_entries, fill_entries, fill_table, list_tiles
from .compositing_kernels import FEATURES, ROW, SIZE, K, composite_backward, composite_forward, sum_entries
from .launch import blocks, launch

_TINY = 2.0**-125  # smaller alphas and T are 0: products with them would be denormal
# bytes of an entry: tile and rank, both sorted, its slot, memory of the sort; its share of T; its row of moments
_PER_ENTRY = 4 * (2 + 2 + 2 + 4 + SIZE * SIZE // K + ROW)
_KEPT_PER_ENTRY = 4 * (1 + 2 + SIZE * SIZE // K)  # rank, slot, share of T
LANES = 32  # Gaussians of a program that goes through their tiles
_BLOCK = 128  # Gaussians or entries of another


@dataclass(frozen=True, eq=False)
class _Rows:
    """A row slice: rows of tiles, numbered through all cameras, and where the entries of each Gaussian begin."""

    begin: int
    end: int
    begins: Tensor
    entries: int


@dataclass(frozen=True, eq=False)
class _Lists:
    """The lists of a row slice, and what its forward pass left; the tensors are those of `.compositing_kernels`."""

    entries: Tensor
    slots: Tensor
    offsets: Tensor
    starts: Tensor
    reached: Tensor


class GpuCompositor(Compositor):
    """Compositing of one call.

    Its constructor reads one number for each row slice that it tries; none for the first where the projection counted.
    """

    def __init__(
        self,
        projected: ProjectedGaussians,
        features: Tensor,
        options: RasterOptions,
        median_depth: bool = False,
        chunk_size: int | None = None,
    ) -> None:
        fields = (projected.means2d, projected.factors, projected.opacities, projected.depths)
        means2d, factors, opacities, depths = (x.detach().contiguous() for x in fields)
        self._size = projected.image_size
        self._cameras = projected.num_cameras
        self._eps2d = projected.eps2d
        self._image_rows, self._columns = (blocks(length, SIZE) for length in self._size)
        self._features = range(0, max(features.shape[1], 1), FEATURES)  # where blocks of them begin
        self._median_depth = median_depth
        self._absgrad = options.absgrad
        self._thresholds = (max(options.alpha_threshold, _TINY), max(options.transmittance_stop, _TINY))
        self._order = torch.argsort(depths, stable=True)
        n = len(projected)
        self._table = depths.new_empty(n, 8)
        footprints = (means2d, factors, opacities)
        known = entry_counts.find(projected, options.alpha_threshold) if n else None
        counts, begins = self._room() if known else (self._order, self._order)  # or what nothing is written to
        arguments = (self._order, *footprints, depths, self._eps2d, n, self._table)
        sorting = (known.counts if known else counts, counts, begins)
        launch(fill_table, (blocks(n, _BLOCK),), *arguments, *sorting, HAS_COUNTS=known is not None, BLOCK=_BLOCK)
        log2_threshold = entry_counts.log2_threshold(options.alpha_threshold)
        ellipses = (self._order, *footprints, projected.camera_ids.contiguous(), self._eps2d, log2_threshold)
        self._ellipses = (*ellipses, *self._size, self._image_rows)
        whole = (_add_up(counts, begins), known.entries) if known else None
        self._max_bytes = options.max_bytes or 0  # or, by how much all lists take, in `_fitting`
        self._kept: list[_Lists] = []
        self._slices = self._fitting(0, self._cameras * self._image_rows, whole)

    def forward(self, inputs: Inputs, keep: bool) -> Images:
        """The images, a row slice after the other; as many of the first are kept as there is room for."""
        features = inputs[3]
        widths = (features.shape[1], 1, 1 if self._median_depth else 0)
        images = [features.new_empty(self._cameras, width, *self._size) for width in widths]
        number = self._number_kept() if keep else 0
        kept = list[_Lists]()
        for i, rows in enumerate(self._slices):
            lists = self._composite_rows(rows, features, images, i < number)
            if i < number:
                kept.append(lists)
            del lists
        self._kept = kept
        return images[0], images[1], images[2]

    def backward(
        self, inputs: Inputs, grad_features: Tensor, grad_transmittance: Tensor, needs: tuple[bool, ...]
    ) -> tuple[tuple[Tensor | None, ...], Tensor | None]:
        """The gradients, a row slice after the other; those that were not kept are composited again."""
        kept, self._kept = self._kept, []
        factors, opacities, features = (x.contiguous() for x in inputs[1:])
        n, channels = features.shape
        needs_absolute = self._absgrad and needs[0]
        input_grads = [x.new_empty(x.shape) for x in inputs]
        absolute = features.new_empty(n, 2) if needs_absolute else features  # to which nothing is written
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
                    (blocks(n, LANES),),
                    *(self._order, rows.begins, moments, factors, opacities, self._eps2d, n, channels, first),
                    *(*input_grads, absolute),
                    MOMENTS=any(needs[:3]),
                    WITH_FEATURES=needs[3],
                    ABSOLUTE=needs_absolute,
                    ADD=later_slice or first > 0,
                    ADD_FEATURES=later_slice,
                    BLOCK=LANES,
                    warps=1,
                )

        for rows in self._slices:
            add(rows, kept.pop(0) if kept else self._composite_rows(rows, features, None, True))
        gradients = tuple(x if need else None for x, need in zip(input_grads, needs, strict=True))
        return gradients, absolute if needs_absolute else None

    def _room(self) -> tuple[Tensor, Tensor]:
        """For the entries of each Gaussian, and for where they begin."""
        n = len(self._order)
        counts = self._order.new_empty(n, dtype=torch.int32)
        return counts, self._order.new_empty(n + 1) if n else self._order.new_zeros(1)

    def _count(self, begin: int, end: int) -> tuple[Tensor, int]:
        """Where the entries of each Gaussian begin in some rows of tiles, and how many there are: a wait."""
        n = len(self._order)
        counts, begins = self._room()
        rows = (begin, end, n, counts, begins)
        launch(count_entries, (blocks(n, LANES),), *self._ellipses, *rows, BLOCK=LANES, warps=1)
        return begins, int(_add_up(counts, begins)[-1])

    def _fitting(self, begin: int, end: int, known: tuple[Tensor, int] | None = None) -> list[_Rows]:
        """Row slices of the rows `begin` to `end` whose lists take at most `max_bytes`: halves, where they do not.

        `known` are the counts of all these rows.
        """
        begins, entries = self._count(begin, end) if known is None else known
        rows = _Rows(begin, end, begins, entries)
        size = self._bytes(rows, _PER_ENTRY)
        if not self._max_bytes:  # these are all rows
            self._max_bytes = default_max_bytes(size, begins.device)
        if size > self._max_bytes and end - begin > 1:
            middle = (begin + end) // 2
            del begins, known, rows
            return self._fitting(begin, middle) + self._fitting(middle, end)
        check_fits(size, self._max_bytes)
        return [rows]

    def _bytes(self, rows: _Rows, per_entry: int) -> int:
        """What the lists of a row slice take."""
        return rows.entries * per_entry + (rows.end - rows.begin) * self._columns * SIZE * SIZE * 4

    def _number_kept(self) -> int:
        """How many row slices can be kept from forward to backward beside the one that is being made."""
        room = self._max_bytes - max(self._bytes(rows, _PER_ENTRY) for rows in self._slices)
        totals = accumulate(self._bytes(rows, _KEPT_PER_ENTRY) for rows in self._slices)
        number = sum(total <= room for total in totals)
        return number + (number == len(self._slices) - 1)  # beside the last none is made

    def _tiles(self, rows: _Rows) -> tuple[int, ...]:
        """How the tiles of a row slice lie in the images."""
        return (rows.begin * self._columns, self._columns, self._image_rows, *self._size)

    def _composite_rows(self, rows: _Rows, features: Tensor, images: list[Tensor] | None, keep: bool) -> _Lists:
        """Fill sums, transmittance and median depth; without images only compute what `backward` needs again."""
        n = len(self._order)
        tiles = (rows.end - rows.begin) * self._columns
        kind = torch.int16 if tiles < 2**15 else torch.int32  # sorted in half the time
        keys = self._order.new_empty(rows.entries, dtype=kind)
        ranks = self._order.new_empty(rows.entries, dtype=torch.int32)
        where = (rows.begin, rows.end, n, self._columns, rows.begins, keys, ranks)
        launch(fill_entries, (blocks(n, LANES),), *self._ellipses, *where, BLOCK=LANES, warps=1)
        keys, slots = torch.sort(keys, stable=True)
        entries = torch.empty_like(ranks)
        offsets = self._order.new_empty(tiles + 1)
        lists = (rows.entries, tiles, rows.entries.bit_length(), entries, offsets)
        grid = (blocks(max(rows.entries, tiles + 1), _BLOCK),)
        launch(list_tiles, grid, keys, slots, ranks, *lists, BLOCK=_BLOCK)
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


def _add_up(counts: Tensor, begins: Tensor) -> Tensor:
    """Fill all but the first of `begins`, which is 0, with the sums of the counts up to each; returns it."""
    torch.cumsum(counts, 0, out=begins[1:])
    return begins
