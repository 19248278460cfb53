"""The lists of the tiles: which Gaussian reaches which tile, front to back.

A Gaussian reaches a pixel where alpha = o exp(-q/2) is at least the threshold: inside the ellipse q <= 2 ln(o/th).
For each row of tiles the columns that the ellipse touches are closed form, because an ellipse is convex: its rightmost
point within a horizontal strip lies at its own rightmost point if that is in the strip, else on the strip's nearer
edge. Every tile of this span is touched, every other is not; no tile has to be tested.

Rows of tiles are numbered through all cameras. On a GPU reading a number waits until all work is done, so sizes
that follow from others are computed on the host.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import torch
from torch import Tensor

from kgs.backends.row_slices import row_slices
from kgs.geometry.covariance import variances
from kgs.geometry.projection import cut_squared
from kgs.geometry.types import ProjectedGaussians, RasterOptions


@dataclass(frozen=True, eq=False)
class TileLists:
    """For each tile of a row slice its list: the Gaussians that can reach it, front to back. Integers."""

    tile_size: int  # side of a tile in pixels
    grid: tuple[int, int]  # (rows, columns) of tiles in one image
    first_tile: int  # number of the slice's first tile; tiles are numbered row by row, camera after camera
    offsets: Tensor  # (T + 1,) int64; the entries of tile t are offsets[t]:offsets[t + 1]
    entries: Tensor  # (E,) int32, position in `ids`, sorted by tile and then from front to back
    ids: Tensor  # (n,) int64, the rows of `ProjectedGaussians` that may have entries, in depth order
    order: Tensor  # (E,) int64, which position each entry has if they are sorted by `ids` first and then by tile

    @property
    def num_tiles(self) -> int:
        """How many tiles the slice has."""
        return self.offsets.shape[0] - 1

    @property
    def by_gaussian(self) -> Tensor:
        """The entries of `ids[0]`, then of `ids[1]`, ..., `(E,)` int64; computed at each call."""
        entries = torch.arange(self.order.shape[0], device=self.order.device)
        return torch.empty_like(self.order).scatter_(0, self.order, entries)

    @property
    def gaussian_offsets(self) -> Tensor:
        """Where the entries of each of `ids` begin in `by_gaussian`, `(n,)` int64; computed at each call."""
        sorted_entries = self.entries.index_select(0, self.by_gaussian)
        return torch.searchsorted(sorted_entries, _arange(self.ids))


@dataclass(frozen=True, eq=False)
class Spans:
    """For each Gaussian and each row of tiles that it reaches the first tile and how many; int32, `(S,)`."""

    ranks: Tensor  # position of the Gaussian in `TileCoverage.ids`, ascending
    rows: Tensor  # row of tiles
    first: Tensor  # first column
    counts: Tensor  # columns, may be 0

    def take(self, where: slice) -> Self:
        """Some of the spans."""
        return replace(self, **{name: value[where] for name, value in vars(self).items()})


class TileCoverage:
    """The rows of tiles that each Gaussian reaches; lists are made from it, a row slice and a depth slice at a time.

    Memory is proportional to the Gaussians and, at any time, to at most `max_spans` spans.

    Attributes:
        ids: `(n,)`, rows of `projected` that reach a tile, in depth order; equal depths keep their order.
        total_rows: R, rows of tiles of all cameras.
        spans_per_row, entries_per_row: how many each of the R rows has.
        num_spans, num_entries: of all rows.
    """

    @torch.no_grad()
    def __init__(
        self, projected: ProjectedGaussians, tile_size: int, alpha_threshold: float, max_spans: int = 2**40
    ) -> None:
        height, width = projected.image_size
        self.tile_size = tile_size
        self.grid = (-(-height // tile_size), -(-width // tile_size))
        self.total_rows = projected.num_cameras * self.grid[0]
        self._width = width
        xx, xy, yy, det = variances(projected.factors, projected.eps2d)
        cut = torch.where(xx + yy < torch.inf, cut_squared(projected.opacities, alpha_threshold), -torch.inf)
        half_height = (cut.clamp_min(0.0) * yy).sqrt()
        x, y = projected.means2d.unbind(1)
        top = torch.ceil(y - half_height).clamp(0, height)
        bottom = torch.floor(y + half_height).clamp(-1, height - 1)
        ids = ((cut > 0) & (bottom >= top)).nonzero()[:, 0]
        ids = ids.index_select(0, projected.depths.index_select(0, ids).argsort(stable=True))
        self.ids = ids
        self._camera_row = projected.camera_ids.index_select(0, ids).int().mul_(self.grid[0])
        self._first_row = (top.index_select(0, ids) / tile_size).floor().int()
        self._num_rows = (bottom.index_select(0, ids) / tile_size).floor().int() - self._first_row + 1
        # a column of numbers per Gaussian, gathered once for each row of tiles that it reaches
        columns = [x, y, half_height, cut, xy / yy, det / yy, yy.reciprocal(), xy * (cut / xx).sqrt()]
        table = torch.stack(columns).index_select(1, ids)
        self._table = torch.nan_to_num(table, nan=torch.inf, posinf=torch.inf, neginf=torch.inf)
        self._count(max_spans)

    def _count(self, max_spans: int) -> None:
        """Count spans and entries, some Gaussians at a time; keep the spans where there is room for all."""
        n = self.ids.shape[0]
        ends = torch.cumsum(self._num_rows, 0)
        self.num_spans = int(ends[-1]) if n else 0
        self._all_spans: Spans | None = None
        cuts = range(max_spans, self.num_spans, max_spans)
        inner = torch.searchsorted(ends, ends.new_tensor(cuts)).tolist() if cuts else []
        bounds = [0, *sorted(set(inner) - {0, n}), n]
        counts_per_row = ends.new_zeros(2, self.total_rows)  # spans, entries
        entries_up_to = []
        for low, high in pairwise(bounds):
            spans = self.spans(0, self.total_rows, low, high)
            last_spans = ends[low:high] - 1 - (ends[low - 1] if low else 0)
            entries_before = counts_per_row[1].sum()
            entries_up_to.append(torch.cumsum(spans.counts, 0).index_select(0, last_spans) + entries_before)
            added = torch.stack([torch.ones_like(spans.counts), spans.counts]).long()
            counts_per_row.index_add_(1, spans.rows, added)
            self._all_spans = spans if len(bounds) == 2 else None
        self._entries_up_to = torch.cat(entries_up_to)
        self.spans_per_row, self.entries_per_row = counts_per_row.tolist()
        self.num_entries = sum(self.entries_per_row)

    def row_slices(self, max_bytes: int, per_span: int, per_entry: int) -> list[tuple[int, int]]:
        """Consecutive rows whose spans and entries take at most `max_bytes` together; an error where one takes more."""
        counts = zip(self.spans_per_row, self.entries_per_row, strict=True)
        row_bytes = [spans * per_span + entries * per_entry for spans, entries in counts]
        return row_slices(row_bytes, max_bytes)

    def depth_slices(self, layers: int) -> list[tuple[int, int]]:
        """Consecutive ranges of `ids`, nearest first, of about `layers` entries per tile each."""
        n = self.ids.shape[0]
        count = round(self.num_entries / max(1, layers * self.total_rows * self.grid[1]))
        if count <= 1:
            return [(0, n)]
        targets = torch.arange(1, count, device=self.ids.device) * (self.num_entries // count)
        cuts = torch.searchsorted(self._entries_up_to, targets).tolist()
        return list(pairwise([0, *sorted(set(cuts) - {0, n}), n]))

    def spans(self, begin: int, end: int, low: int = 0, high: int | None = None) -> Spans:
        """The spans of the Gaussians `ids[low:high]` in the rows `begin` to `end` (exclusive)."""
        if (begin, end, low, high) == (0, self.total_rows, 0, None) and self._all_spans is not None:
            return self._all_spans
        camera_row = self._camera_row[low:high]
        first_row = self._first_row[low:high]
        num_rows = self._num_rows[low:high]
        if (begin, end) != (0, self.total_rows):
            first = (camera_row + first_row).clamp_(begin, end)
            last = (camera_row + first_row + num_rows).clamp_(begin, end)
            first_row = first - camera_row
            num_rows = last - first
        ranks = torch.repeat_interleave(_arange(num_rows), num_rows, output_size=int(num_rows.sum(dtype=torch.int64)))
        start = torch.cumsum(num_rows, 0, dtype=torch.int32) - num_rows
        rows = _arange(ranks) + (first_row - start).index_select(0, ranks)
        columns = (column[low:high].index_select(0, ranks) for column in self._table)
        x, y, half_height, cut, slope, across, inverse_yy, rightmost = columns
        top = rows * float(self.tile_size) - y
        bottom = torch.minimum(top + (self.tile_size - 1), half_height)
        top = torch.maximum(top, -half_height)
        everywhere = torch.isinf(cut)

        def edge(sign: int) -> Tensor:
            dy = torch.minimum(torch.maximum(sign * rightmost, top), bottom)
            half = ((cut - dy * dy * inverse_yy).clamp_min_(0.0) * across).sqrt_()
            return torch.where(everywhere, sign * torch.inf, torch.addcmul(x, slope, dy).add_(half, alpha=sign))

        left = torch.ceil(edge(-1)).clamp_(0, self._width)
        right = torch.floor(edge(1)).clamp_(-1, self._width - 1)
        first = (left / self.tile_size).floor().int()
        counts = ((right / self.tile_size).floor().int() - first + 1).mul_(right >= left)
        rows += camera_row.index_select(0, ranks)
        return Spans(ranks + low if low else ranks, rows, first, counts)

    def lists(
        self, spans: Spans, begin: int, end: int, ranks: tuple[int, int] | None = None, live: Tensor | None = None
    ) -> TileLists:
        """The lists of the tiles in the rows `begin` to `end`, whose spans are given.

        They hold a depth slice, the range `ranks` of `ids`, or all; those of the tiles that are not `live` are empty.
        """
        low, high = ranks or (0, self.ids.shape[0])
        if (low, high) == (0, self.ids.shape[0]):
            size = sum(self.entries_per_row[begin:end])
        else:
            cuts = torch.searchsorted(spans.ranks, torch.tensor([low, high], device=self.ids.device)).tolist()
            spans = spans.take(slice(*cuts))
            size = int(spans.counts.sum(dtype=torch.int64))
        columns = self.grid[1]
        counts = spans.counts
        # in the order of the Gaussians: entry e of a span is tile (row, first + e)
        start = torch.cumsum(counts, 0, dtype=torch.int32) - counts
        span = torch.repeat_interleave(_arange(counts), counts, output_size=size)
        tiles = _arange(span) + ((spans.rows - begin) * columns + spans.first - start).index_select(0, span)
        entries = (spans.ranks - low).index_select(0, span)
        if live is not None:
            inside = live.index_select(0, tiles).nonzero()[:, 0]
            tiles = tiles.index_select(0, inside)
            entries = entries.index_select(0, inside)
        num_tiles = (end - begin) * columns
        keys, order = torch.sort(tiles.short() if num_tiles < 2**15 else tiles, stable=True)
        offsets = torch.searchsorted(keys, torch.arange(num_tiles + 1, dtype=keys.dtype, device=keys.device))
        entries = entries.index_select(0, order)
        return TileLists(self.tile_size, self.grid, begin * columns, offsets, entries, self.ids[low:high], order)


def bin_to_tiles(
    projected: ProjectedGaussians,
    tile_size: int = 8,
    alpha_threshold: float = RasterOptions.alpha_threshold,
) -> TileLists:
    """The lists of all tiles of all cameras at once, see `TileCoverage`."""
    coverage = TileCoverage(projected, tile_size, alpha_threshold)
    return coverage.lists(coverage.spans(0, coverage.total_rows), 0, coverage.total_rows)


def _arange(like: Tensor) -> Tensor:
    return torch.arange(like.shape[0], dtype=torch.int32, device=like.device)
