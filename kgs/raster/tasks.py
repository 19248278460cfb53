"""What a pass works on: the data of a slice, its groups of tiles, and the record of a step.

The tiles of a slice are sorted by the length of their lists and taken in groups; a group is one piece of work for one
thread. Within a group, step j does the j-th chunk of K entries of every tile that still has one and still lets light
through; tiles that are done leave the group once they are a fifth of it.
"""

import math
from dataclasses import dataclass, field
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor

from .tiles import Reach, TileLists

ALPHA_MAX = 0.99
_STEP_PAIRS = {"cpu": 2**19, "cuda": 2**24}  # pairs (Gaussian, pixel) of a step: few operator calls, small buffers
_BUFFERS = 7  # numbers per pair, intermediate values of products included
_PAIRS_TO_SHARE = 2**22  # from here on a CPU has work for two groups, so for two threads


@dataclass(frozen=True)
class Rules:
    """What counts as a layer, see `kgs.composite`, and how much memory a step has."""

    alpha_threshold: float
    transmittance_stop: float
    median_depth: bool
    chunk_size: int  # K, entries of a tile per step
    buffer_bytes: int  # for the buffers of one thread
    threads: int  # that have buffers, at most


@dataclass(frozen=True)
class Step:
    """The record of one step of a group, for the backward pass."""

    chunk: int  # which chunk of each tile's list
    rows: Tensor | None  # positions in the group of its tiles; None: the first ones
    count: int  # n, how many tiles
    transmittance: Tensor  # before the step, (n, P)
    alpha: Tensor | None  # (K, n, P), where there is memory to keep it
    ended: bool  # whether the transmittance of a pixel fell to the stop


@dataclass
class Group:
    """Tiles that are worked on together, the longest list first, and the steps that were done on them."""

    tiles: Tensor  # numbers in the slice, (m,)
    starts: Tensor  # first entry of each, (m,)
    ends: Tensor  # one past the last entry of each, (m,)
    chunks: list[int]  # how many each has, descending
    steps: list[Step] = field(default_factory=list)


class Slice:
    """The tiles of a row slice with their entries of a depth slice, and the n Gaussians in their lists.

    `table` is `(10, n + 1)`, see `kgs.covariance.footprint_table`, `features` `(n + 1, F)`, and `depths` `(n + 1,)` or
    None where no median depth is wanted; the last of each is a dummy without effect.
    """

    def __init__(self, table: Tensor, features: Tensor, depths: Tensor | None, lists: TileLists, rules: Rules) -> None:
        self.table, self.features, self.depths, self.lists, self.rules = table, features, depths, lists, rules
        size, dtype, device = lists.tile_size, table.dtype, table.device
        self.pixels, self.chunk_size = size * size, rules.chunk_size
        self.entries = F.pad(lists.entries, (0, self.chunk_size), value=features.shape[0] - 1)
        self.slots = torch.arange(self.chunk_size, device=device)
        local = torch.arange(size, device=device).to(dtype) - (size - 1) / 2
        x, y = local.repeat(size), local.repeat_interleave(size)
        self.monomials = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])
        tile = torch.arange(lists.first_tile, lists.first_tile + lists.num_tiles, device=device)
        row = torch.div(tile, lists.grid[1], rounding_mode="floor")
        columns = torch.stack([tile - row * lists.grid[1], row % lists.grid[0]])
        self.centres = (columns * size).to(dtype) + (size - 1) / 2
        # exp is slow where its result is denormal: the exponent is bounded below, and what that lets through is cut
        threshold = rules.alpha_threshold
        self.floor = math.log(threshold) - 20 if threshold else math.log(torch.finfo(dtype).tiny) + 8
        self.cut = _below(max(threshold, 1.01 * math.exp(self.floor)), dtype)
        self.stop = _below(rules.transmittance_stop, dtype) if rules.transmittance_stop else -1.0
        # Scans: a GPU wants few launches, a CPU few passes. Sums along the layers of a GPU are not deterministic.
        self.by_layer = device.type == "cpu" or torch.are_deterministic_algorithms_enabled()
        self.clamps = bool((table[0] > math.log(ALPHA_MAX)).any())
        self.groups = self._make_groups(lists.offsets.diff())
        slots = self.chunk_size * sum(sum(group.chunks) for group in self.groups)
        self.alpha_bytes = slots * self.pixels * table.element_size()  # to keep all alphas

    def blank(self) -> tuple[Tensor, ...]:
        """Sums before the first layer: transmittance `(T, 1, P)`, median depth `(T, 1 or 0, P)`, features `(T, f, P)`.

        The features are three at a time: what is asked for beside the image does not change its bits.
        """
        widths = [0 if self.depths is None else 1, *(block.shape[1] for block in self.features.split(3, dim=1))]
        zeros = (self.table.new_zeros(self.lists.num_tiles, width, self.pixels) for width in widths)
        return self.table.new_ones(self.lists.num_tiles, 1, self.pixels), *zeros

    def _make_groups(self, lengths: Tensor) -> list[Group]:
        chunks = torch.div(lengths + (self.chunk_size - 1), self.chunk_size, rounding_mode="floor")
        chunks, order = torch.sort(chunks, descending=True, stable=True)
        order = order[: int((chunks > 0).sum())]
        counts = chunks[: len(order)].tolist()
        starts, ends = (x.index_select(0, order) for x in (self.lists.offsets[:-1], self.lists.offsets[1:]))
        pairs = self.chunk_size * self.pixels
        most_tiles = max(1, self.rules.buffer_bytes // (_BUFFERS * self.table.element_size()) // pairs)
        shared = self.by_layer and sum(counts) * pairs >= _PAIRS_TO_SHARE
        most_chunks = -(-sum(counts) // 2) if shared else sum(counts)
        bounds, work = [0], 0
        for i, count in enumerate(counts):
            if i - bounds[-1] == most_tiles or (i > bounds[-1] and work + count > most_chunks):
                bounds.append(i)
                work = 0
            work += count
        parts = [slice(*pair) for pair in pairwise([*bounds, len(counts)])] if counts else []
        return [Group(order[part], starts[part], ends[part], counts[part]) for part in parts]


def buffer_bytes(max_bytes: int, like: Tensor) -> int:
    """What the buffers of one thread may take: all that they want, or a part of the bound where it is tight."""
    device = like.device.type
    wanted = _STEP_PAIRS.get(device, 2**24) * _BUFFERS * like.element_size()
    return min(wanted, max_bytes // (16 if device == "cpu" else 2))


def choose_chunk_size(reach: Reach) -> int:
    """Short chunks waste little at the ends of lists; long ones need fewer operator calls, so few tiles want them.

    One size for all slices of a picture: it decides the order in which the layers of a pixel are added.
    """
    if reach.ids.device.type != "cpu":
        return 32
    tiles = reach.total_rows * reach.grid[1]
    mean, few = reach.num_entries / max(1, tiles), tiles * reach.tile_size**2 <= 2**13
    return 8 if mean < 32 else 32 if few and mean >= 64 else 16


def _below(value: float, dtype: torch.dtype) -> float:
    """The largest number below `value`: torch's threshold keeps what is strictly larger."""
    bound = torch.tensor(value, dtype=dtype, device="cpu")
    return float(torch.nextafter(bound, torch.zeros_like(bound)))
