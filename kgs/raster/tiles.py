"""Which Gaussians can reach which tile, front to back.

A Gaussian reaches a pixel where alpha = o exp(-q/2) is at least the threshold: inside the ellipse q <= 2 ln(o/th).
For each row of tiles the columns that the ellipse touches are closed form, because an ellipse is convex: its rightmost
point within a horizontal band lies at its own rightmost point if that is in the band, else on the band's nearer edge.
Every tile of the span is touched, every other is not; no tile has to be tested.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor

from kgs.covariance import variances
from kgs.projection import cut_squared
from kgs.types import ProjectedGaussians, TileBins

__all__ = ["TileSpans", "bin_to_tiles", "tile_spans"]


def bin_to_tiles(projected: ProjectedGaussians, tile_size: int = 8, alpha_threshold: float = 1 / 255) -> TileBins:
    """Depth-sorted lists of Gaussians for all tiles of all cameras.

    Args:
        projected: what `project` returned.
        tile_size: side of the square tiles in pixels.
        alpha_threshold: alphas below it do not count; with 0 every Gaussian is in every tile of its camera.

    Returns:
        The lists; equal depths keep the order of `projected`. A Gaussian of opacity 0 is in none.
    """
    spans = tile_spans(projected, tile_size, alpha_threshold)
    return spans.bin(0, spans.entries_per_row.shape[0])


@dataclass(frozen=True)
class TileSpans:
    """For each Gaussian and each row of tiles the first tile and how many.

    Rows of tiles are numbered through all cameras; memory is proportional to Gaussians times the rows they touch.

    Args:
        tile_size: side of a tile in pixels.
        grid: (rows, columns) of tiles of one image.
        ids: `(n,)`, rows of the `ProjectedGaussians` that touch a tile, in depth order.
        ranks: `(S,)` int32, position in `ids`, ascending.
        rows: `(S,)` int32, row of tiles.
        first: `(S,)` int32, first column.
        counts: `(S,)` int32, columns, may be 0.
        entries_per_row: `(R,)` int64, sum of `counts` for each row of tiles.
    """

    tile_size: int
    grid: tuple[int, int]
    ids: Tensor
    ranks: Tensor
    rows: Tensor
    first: Tensor
    counts: Tensor
    entries_per_row: Tensor

    def bands(self, max_entries: int) -> list[tuple[int, int]]:
        """Consecutive ranges of rows with at most `max_entries` entries each.

        Raises:
            ValueError: one row of tiles alone has more.
        """
        bands, begin, total = [], 0, 0
        for row, entries in enumerate(self.entries_per_row.tolist()):
            if entries > max_entries:
                raise ValueError(
                    f"max_bytes: one row of tiles needs {entries} entries, the budget allows {max_entries}; "
                    "raise max_bytes, or render fewer or smaller Gaussians"
                )
            if total + entries > max_entries:
                bands.append((begin, row))
                begin, total = row, 0
            total += entries
        bands.append((begin, self.entries_per_row.shape[0]))
        return bands

    def depth_ranges(self, layers: int) -> list[tuple[int, int]]:
        """Consecutive ranges of `ids`, nearest first, of about `layers` entries a tile each."""
        total, tiles = int(self.entries_per_row.sum()), self.entries_per_row.shape[0] * self.grid[1]
        count = max(1, round(total / max(1, layers * tiles)))
        if count == 1:
            return [(0, self.ids.shape[0])]
        entries = torch.cumsum(self.counts, 0)
        targets = torch.arange(1, count, device=entries.device) * (total // count)
        cuts = self.ranks.index_select(0, torch.searchsorted(entries, targets)).unique().tolist()
        bounds = [0, *(cut for cut in cuts if cut > 0), self.ids.shape[0]]
        return list(pairwise(bounds))

    def bin(self, begin: int, end: int, ranks: tuple[int, int] | None = None, live: Tensor | None = None) -> TileBins:
        """The lists of the tiles in rows `begin` to `end` (exclusive).

        Args:
            begin: first row of tiles.
            end: one past the last row.
            ranks: range of `ids` to list; None: all.
            live: which of these tiles want a list, `(T,)`; None: all.
        """
        spans: tuple[Tensor, ...] = (self.ranks, self.rows, self.first, self.counts)
        low, high = ranks or (0, self.ids.shape[0])
        if (low, high) != (0, self.ids.shape[0]):
            cuts = torch.searchsorted(self.ranks, torch.tensor([low, high], device=self.ranks.device)).tolist()
            spans = tuple(x[slice(*cuts)] for x in spans)
        if (begin, end) != (0, self.entries_per_row.shape[0]):
            inside = ((spans[1] >= begin) & (spans[1] < end)).nonzero()[:, 0]
            spans = tuple(x.index_select(0, inside) for x in spans)
        if live is not None:
            alive = F.pad(torch.cumsum(live.int(), 0, dtype=torch.int32), (1, 0))
            left = (spans[1] - begin) * self.grid[1] + spans[2]
            inside = (alive.index_select(0, left + spans[3]) > alive.index_select(0, left)).nonzero()[:, 0]
            spans = tuple(x.index_select(0, inside) for x in spans)
        rank, rows, first, counts = spans
        columns = self.grid[1]
        num_tiles = (end - begin) * columns
        num_entries = int(counts.sum(dtype=torch.int64))
        # in the order of the Gaussians: entry e of a span is tile (row, first + e)
        start = torch.cumsum(counts, 0, dtype=torch.int32) - counts
        span = torch.repeat_interleave(_arange(counts), counts, output_size=num_entries)
        tiles = _arange(span) + ((rows - begin) * columns + first - start).index_select(0, span)
        entries = (rank - low).index_select(0, span)
        if live is not None:
            inside = live.index_select(0, tiles).nonzero()[:, 0]
            tiles, entries = tiles.index_select(0, inside), entries.index_select(0, inside)
        keys, order = torch.sort(tiles.short() if num_tiles < 2**15 else tiles, stable=True)
        per_tile = torch.bincount(keys, minlength=num_tiles)
        return TileBins(
            tile_size=self.tile_size,
            grid=self.grid,
            first_tile=begin * columns,
            offsets=torch.cat([per_tile.new_zeros(1), torch.cumsum(per_tile, 0)]),
            entries=entries.index_select(0, order),
            ids=self.ids[low:high],
            order=order,
        )


@torch.no_grad()
def tile_spans(projected: ProjectedGaussians, tile_size: int, alpha_threshold: float) -> TileSpans:
    """The exact span of every Gaussian in every row of tiles; see the head of this file."""
    height, width = projected.image_size
    grid = (-(-height // tile_size), -(-width // tile_size))
    cut = cut_squared(projected.opacities, alpha_threshold)
    xx, xy, yy, det = variances(projected.factors, projected.eps2d)
    reach = (cut.clamp_min(0.0) * yy).sqrt()
    y = projected.means2d[:, 1]
    top = torch.ceil(y - reach).clamp(0, height)
    bottom = torch.floor(y + reach).clamp(-1, height - 1)
    ids = ((cut > 0) & (bottom >= top)).nonzero()[:, 0]
    depths = projected.depths.index_select(0, ids)
    ids = ids.index_select(0, torch.sort(depths, stable=True).indices)

    # a column of numbers a Gaussian, gathered once for each row of tiles that it touches
    first_row = (top.index_select(0, ids) / tile_size).floor().int()
    num_rows = (bottom.index_select(0, ids) / tile_size).floor().int() - first_row + 1
    num_spans = int(num_rows.sum(dtype=torch.int64))
    ranks = torch.repeat_interleave(_arange(num_rows), num_rows, output_size=num_spans)
    start = torch.cumsum(num_rows, 0, dtype=torch.int32) - num_rows
    rows = _arange(ranks) + (first_row - start).index_select(0, ranks)
    table = torch.stack(
        [projected.means2d[:, 0], y, reach, cut, xy / yy, det / yy, yy.reciprocal(), xy * (cut / xx).sqrt()]
    ).index_select(1, ids)
    table = torch.where(table.isfinite(), table, torch.inf)
    x, y, reach, cut, slope, across, inverse_yy, rightmost = (column.index_select(0, ranks) for column in table)
    low = rows * float(tile_size) - y
    high = torch.minimum(low + (tile_size - 1), reach)
    low = torch.maximum(low, -reach)
    everywhere = torch.isinf(cut)

    def edge(sign: int) -> Tensor:
        dy = torch.minimum(torch.maximum(sign * rightmost, low), high)
        half = ((cut - dy * dy * inverse_yy).clamp_min_(0.0) * across).sqrt_()
        return torch.addcmul(x, slope, dy).add_(half, alpha=sign)

    left = torch.where(everywhere, -torch.inf, edge(-1))
    right = torch.where(everywhere, torch.inf, edge(1))
    left = torch.ceil(left).clamp_(0, width)
    right = torch.floor(right).clamp_(-1, width - 1)
    first = (left / tile_size).floor().int()
    counts = ((right / tile_size).floor().int() - first + 1).mul_(right >= left)
    rows += projected.camera_ids.index_select(0, ids).int().mul_(grid[0]).index_select(0, ranks)
    entries_per_row = torch.zeros(projected.num_cameras * grid[0], dtype=torch.int64, device=rows.device)
    entries_per_row.index_add_(0, rows, counts.long())
    return TileSpans(tile_size, grid, ids, ranks, rows, first, counts, entries_per_row)


def _arange(like: Tensor) -> Tensor:
    return torch.arange(like.shape[0], dtype=torch.int32, device=like.device)
