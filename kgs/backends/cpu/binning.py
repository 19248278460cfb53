"""Tile lists, laid out for the kernels: what each Gaussian reaches, row slices, and the bands of a row slice.

The lists of a band, some rows of tiles, are made and used by one thread. The Gaussians that reach a band are its
members, numbered in depth order within the band: what a band reads of its members and adds up for them lies close
together in memory, however many Gaussians the image has. Small Gaussians rarely span bands, so there is little
duplication.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kgs._support.compiled.lanes import WIDTH
from kgs._support.compiled.threads import parallel_for
from kgs._support.memory import array

from .binning_kernels import (
    SIZE,
    begin_spans,
    count_rows,
    fill_band,
    fill_tables,
    find_members,
    find_rows,
    find_spans,
    sort_by_depth,
)

BANDS = 16
MIN_ENTRIES = 4096  # entries of a band: the fixed work of a band costs as much as some hundreds of entries


def table_width(channels: int, median_depth: bool) -> int:
    """Columns of the table: what `fill_tables` writes, in whole lanes."""
    return -(-(7 + channels + median_depth) // WIDTH) * WIDTH


@dataclass(frozen=True, eq=False)
class Band:
    """The lists of the tiles in some rows, front to back."""

    first_tile: int
    members: slice  # of the members of its slice
    table: NDArray[np.float32]  # of its members
    offsets: NDArray[np.int64]  # (T + 1,); the entries of its tile t are offsets[t]:offsets[t + 1]
    entries: NDArray[np.int32]  # numbers of members


@dataclass(frozen=True, eq=False)
class RowSlice:
    """Some rows of tiles: the spans in them, and how they are divided into bands."""

    first_row: int
    starts: NDArray[np.int64]  # (n + 1,)
    spans: NDArray[np.int32]
    bounds: NDArray[np.int64]  # (B + 1,), rows
    offsets: NDArray[np.int64]  # (B + 1,); the members of band b are members[offsets[b]:offsets[b + 1]]
    members: NDArray[np.int32]  # positions in depth order
    table: NDArray[np.float32]  # for `Band`, as the next: parts of large arrays are faster to get than small ones
    entries: NDArray[np.int32]
    entry_offsets: NDArray[np.int64]  # (B + 1,); of the bands


class TileCoverage:
    """The rows of tiles that each Gaussian reaches; lists are made from it, a row slice and a band at a time.

    Attributes:
        grid: (rows, columns) of tiles in one image.
        total_rows: rows of tiles of all cameras.
        ids: `(n,)`, the Gaussians that reach a row of tiles, in depth order.
        ranks: `(M,)`, position in `ids`, or -1.
        spans_per_row, entries_per_row: `(total_rows,)`.
    """

    def __init__(
        self,
        inputs: Sequence[NDArray[Any]],
        image_size: tuple[int, int],
        cameras: int,
        eps2d: np.float32,
        alpha_threshold: np.float32,
        channels: int,
        median_depth: bool,
        max_spans: int,
        threads: int,
    ) -> None:
        height, width = image_size
        self.grid = (-(-height // SIZE), -(-width // SIZE))
        self.total_rows = cameras * self.grid[0]
        self._width = width
        self._parallel_for = partial(parallel_for, threads)
        means2d, factors, opacities, _, depths, _ = inputs
        m = len(depths)
        rows = array((m, 2), np.int32)
        ids = array(m, np.int32)
        self.ranks = array(m, np.int32)
        self._parallel_for(m, find_rows, means2d, factors, opacities, eps2d, alpha_threshold, height, rows)
        n = sort_by_depth(depths.view(np.uint32), rows, ids, self.ranks)
        self.ids = ids[:n]
        self.heads = array((n, 2), np.int32)
        self.geometry = array((n, 8))
        self.table = array((n, table_width(channels, median_depth)))
        sizes = (eps2d, alpha_threshold, self.grid[0], rows, channels)
        self._parallel_for(n, fill_tables, self.ids, *inputs, *sizes, self.heads, self.geometry, self.table)
        self._count(max_spans)

    def _count(self, max_spans: int) -> None:
        """Count spans and entries, some Gaussians at a time; keep the spans where there is room for all."""
        n = len(self.ids)
        ends = np.cumsum(self.heads[:, 1])
        total = int(ends[-1]) if n else 0
        bounds = [0, *sorted({*np.searchsorted(ends, range(max_spans, total, max_spans)).tolist()}), n]
        self.spans_per_row, self.entries_per_row = np.zeros((2, self.total_rows), np.int64)
        self._all_spans = None
        for low, high in pairwise(bounds):
            spans = self._spans(0, self.total_rows, low, high)
            count_rows(self.heads[low:high], *spans, self.spans_per_row, self.entries_per_row)
            self._all_spans = spans if len(bounds) == 2 else None

    def _spans(self, begin: int, end: int, low: int, high: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Where the spans of each Gaussian start, and the spans of the Gaussians `low` to `high` in some rows."""
        heads = self.heads[low:high]
        starts = array(high - low + 1, np.int64)
        begin_spans(heads, begin, end, starts)
        spans = array(starts[-1], np.int32)
        rest = (begin, end, self.grid[0], self._width, heads, self.geometry[low:high], starts, spans)
        self._parallel_for(high - low, find_spans, *rest)
        return starts, spans

    def row_slice(self, begin: int, end: int) -> RowSlice:
        """The rows `begin` to `end` (exclusive), in bands of about equal work."""
        if self._all_spans is None or (begin, end) != (0, self.total_rows):
            self._all_spans = None
            starts, spans = self._spans(begin, end, 0, len(self.ids))
        else:
            starts, spans = self._all_spans
        work = np.cumsum(self.entries_per_row + self.grid[1])
        before = work[begin - 1] if begin else 0
        count = max(1, round(min(BANDS, work[-1] / MIN_ENTRIES) * (work[end - 1] - before) / work[-1]))
        targets = before + np.arange(1, count) * (work[end - 1] - before) / count
        bounds = np.unique([begin, *(np.searchsorted(work, targets) + 1), end])
        offsets = np.zeros(len(bounds), np.int64)
        members = array(len(spans), np.int32)
        band_of_row = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
        find_members(self.heads, begin, end, band_of_row, offsets, members)
        ends = np.concatenate([[0], np.cumsum(self.entries_per_row[begin:end])])[bounds - begin]
        table = array((int(offsets[-1]), self.table.shape[1]))
        entries = array(ends[-1], np.int32)
        return RowSlice(begin, starts, spans, bounds, offsets, members[: offsets[-1]], table, entries, ends)

    def band(self, part: RowSlice, b: int) -> Band:
        """The lists of a band."""
        begin, end = part.bounds[b : b + 2]
        own = slice(*part.offsets[b : b + 2])
        columns = self.grid[1]
        members = part.members[own]
        table = part.table[own]
        entries = part.entries[slice(*part.entry_offsets[b : b + 2])]
        offsets = np.zeros((end - begin) * columns + 1, np.int64)
        spans = (part.first_row, columns, self.heads, part.starts, part.spans, members)
        fill_band(begin, end, *spans, self.table, offsets, entries, table)
        return Band(begin * columns, own, table, offsets, entries)
