"""The inner loop of compositing: a band of tiles, a step of chunks at a time. See `compositing` for the formulas.

Tiles are sorted by the length of their lists and taken in groups; a group is one piece of work for one thread. Within
a group, step j does the j-th chunk of K entries of every tile that still has one and still lets light through; tiles
that are done leave the group once they are a fifth of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from kgs.types import TileBins

from .threads import run_all
from .tiles import TileSpans
from .torch_passes import ALPHA_MAX, Backward, Forward, Group

__all__ = ["Band", "Rules", "choose_chunk_size"]

_STEP_PAIRS = {"cpu": 2**19, "cuda": 2**24}  # Gaussian-pixel pairs of a step: few operator calls, small buffers
_PAIRS_TO_SHARE = 2**22  # from here on a CPU has work for two groups, so for two threads


@dataclass(frozen=True)
class Rules:
    """What counts as a layer, see `composite`; and how much memory there is to keep alphas for the backward pass."""

    alpha_threshold: float
    transmittance_stop: float
    median_depth: bool
    chunk_size: int
    alpha_bytes: int


class Band:
    """A contiguous range of tiles with lists of a range of depths.

    Args:
        table: `(10, n + 1)`, for each Gaussian ln o, x, y, the three quadratic coefficients of the exponent, and the
            two whitening vectors; the last column is a dummy without effect.
        features: `(n + 1, F)`, the last row 0.
        depths: `(n + 1,)`, or None where no median depth is wanted.
        bins: the lists.
        rules: what counts as a layer.
    """

    def __init__(self, table: Tensor, features: Tensor, depths: Tensor | None, bins: TileBins, rules: Rules) -> None:
        self.table, self.features, self.depths, self.bins, self.rules = table, features, depths, bins, rules
        size, dtype, device = bins.tile_size, table.dtype, table.device
        self.pixels = size * size
        lengths = bins.offsets.diff()
        self.chunk_size = rules.chunk_size
        self.entries = F.pad(bins.entries, (0, self.chunk_size), value=features.shape[0] - 1)
        self.slots = torch.arange(self.chunk_size, device=device)
        local = torch.arange(size, device=device).to(dtype) - (size - 1) / 2
        x, y = local.repeat(size), local.repeat_interleave(size)
        self.monomials = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])
        tile = torch.arange(bins.first_tile, bins.first_tile + bins.num_tiles, device=device)
        row = torch.div(tile, bins.grid[1], rounding_mode="floor")
        columns = torch.stack([tile - row * bins.grid[1], row % bins.grid[0]])
        self.centres = (columns * size).to(dtype) + (size - 1) / 2
        # exp is slow where its result is denormal: the exponent is bounded below, and what that lets through is cut
        floor = math.log(rules.alpha_threshold) - 20 if rules.alpha_threshold else math.log(torch.finfo(dtype).tiny) + 8
        self.floor = floor
        self.cut = _below(max(rules.alpha_threshold, 1.01 * math.exp(floor)), dtype)
        self.stop = _below(rules.transmittance_stop, dtype) if rules.transmittance_stop else -1.0
        self.by_layer = device.type == "cpu"  # scans: a GPU wants few launches, a CPU few passes
        self.clamps = bool((table[0] > math.log(ALPHA_MAX)).any())
        self.groups = self._make_groups(lengths)

    def blank(self) -> tuple[Tensor, ...]:
        """Sums before the first layer: transmittance `(T, 1, P)`, median depth `(T, 1 or 0, P)`, features `(T, f, P)`.

        The features are three at a time: what is asked for beside the image does not change its bits.
        """
        tiles, like = self.bins.num_tiles, self.table
        return (
            like.new_ones(tiles, 1, self.pixels),
            like.new_zeros(tiles, 1 if self.depths is not None else 0, self.pixels),
            *(like.new_zeros(tiles, block.shape[1], self.pixels) for block in self.features.split(3, dim=1)),
        )

    def forward(self, sums: tuple[Tensor, ...], keep: bool) -> int:
        """Add this band's layers to sums that start as `blank`; returns the bytes of the alphas that are kept."""
        slots = self.chunk_size * sum(sum(group.chunks) for group in self.groups)
        alpha_bytes = slots * self.pixels * self.table.element_size()
        keep_alphas = keep and alpha_bytes <= self.rules.alpha_bytes
        blocks = self.features.split(3, dim=1)

        def worker() -> Forward:
            return Forward(self, blocks, sums, keep, keep_alphas)

        run_all(self.groups, worker, self.table.device)
        return alpha_bytes if keep_alphas else 0

    def backward(self, grads: Tensor, behind: Tensor, *, moments: bool, features: bool) -> Tensor:
        """What each Gaussian of the bins gets: six moments of dL/d ln alpha about its centre, and dL/d features.

        Args:
            grads: dL/d sums, `(T, F, P)`.
            behind: V behind the last layer, `(T, 1, P)`, see `compositing`; becomes V before the first.
            moments: whether the moments are wanted.
            features: whether dL/d features is wanted.

        Returns:
            `(n, 6 + F)`, without the columns that are not wanted.
        """
        entries, columns = self.bins.entries.shape[0], 6 * moments + self.features.shape[1] * features
        rows = self.table.new_zeros(entries + 1, columns)
        if entries == 0:
            return rows.new_zeros(self.bins.ids.shape[0], columns)

        def worker() -> Backward:
            return Backward(self, grads, behind, rows, moments, features)

        run_all(self.groups, worker, rows.device)
        # each entry once, in the order of the Gaussians: a sum in fixed order, without atomics
        return F.embedding_bag(self.bins.by_gaussian, rows, self.bins.gaussian_offsets, mode="sum")

    def _make_groups(self, lengths: Tensor) -> list[Group]:
        chunks = torch.div(lengths + (self.chunk_size - 1), self.chunk_size, rounding_mode="floor")
        chunks, order = torch.sort(chunks, descending=True, stable=True)
        order = order[: int((chunks > 0).sum())]
        counts = chunks[: len(order)].tolist()
        starts, ends = self.bins.offsets[:-1].index_select(0, order), self.bins.offsets[1:].index_select(0, order)
        device, pairs = self.table.device.type, self.chunk_size * self.pixels
        most_tiles = max(1, _STEP_PAIRS.get(device, 2**24) // pairs)
        shared = device == "cpu" and sum(counts) * pairs >= _PAIRS_TO_SHARE
        most_chunks = -(-sum(counts) // 2) if shared else sum(counts)
        groups, begin, work = [], 0, 0
        for i, count in enumerate(counts):
            if i - begin == most_tiles or (i > begin and work + count > most_chunks):
                groups.append(slice(begin, i))
                begin, work = i, 0
            work += count
        groups.append(slice(begin, len(counts)))
        return [Group(order[part], starts[part], ends[part], counts[part]) for part in groups if counts]


def choose_chunk_size(spans: TileSpans) -> int:
    """Short chunks waste little at the ends of lists; long ones need fewer operator calls, so few tiles want them.

    One size for all bands of a picture: it decides the order in which the layers of a pixel are added.
    """
    if spans.counts.device.type != "cpu":
        return 32
    tiles = spans.entries_per_row.shape[0] * spans.grid[1]
    mean, few = int(spans.entries_per_row.sum()) / max(1, tiles), tiles * spans.tile_size**2 <= 2**13
    return 8 if mean < 32 else 32 if few and mean >= 64 else 16


def _below(value: float, dtype: torch.dtype) -> float:
    """The largest number below `value`: torch's threshold keeps what is strictly larger."""
    bound = torch.tensor(value, dtype=dtype)
    return float(torch.nextafter(bound, torch.zeros_like(bound)))
