"""One step of compositing, forward and backward, for one thread with its own buffers.

The formulas are those of `compositing`, the arrangement that of `chunks`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

if TYPE_CHECKING:
    from .chunks import Band

__all__ = ["ALPHA_MAX", "Backward", "Forward", "Group", "Step"]

ALPHA_MAX = 0.99
_LIVE_SHARE = 0.8  # a group is compacted when fewer of its tiles than this still let light through


@dataclass(frozen=True)
class Step:
    """One step of a group, as the backward pass needs it."""

    chunk: int
    rows: Tensor | None  # positions in the group of its tiles; None: the first ones
    count: int
    transmittance: Tensor  # before the step, (count, P)


@dataclass
class Group:
    """Tiles that are worked on together, longest list first, and the steps that were done on them."""

    tiles: Tensor  # (m,) numbers in the band
    starts: Tensor  # (m,) first entry
    ends: Tensor  # (m,) one past the last entry
    chunks: list[int]  # descending
    steps: list[Step] = field(default_factory=list)


class _Worker:
    """Buffers of one thread, and the alphas of a step in them."""

    def __init__(self, band: Band, buffers: int) -> None:
        self.band = band
        largest = max((len(group.chunks) for group in band.groups), default=0)
        size = largest * (band.chunk_size + 1) * band.pixels
        self.memory = [band.table.new_empty(size) for _ in range(buffers)]
        self.count = 0

    def shape_buffers(self, n: int) -> None:
        """Views of the buffers for a step of n chunks: (n, K, P) for alpha, (n, K + 1, P) for T, and so on."""
        if n == self.count:
            return
        self.count = n
        k, p = self.band.chunk_size, self.band.pixels
        self.alpha = self.memory[0][: n * k * p].view(n, k, p)
        self.light = self.memory[1][: n * (k + 1) * p].view(n, k + 1, p)

    def entries(self, starts: Tensor, ends: Tensor, chunk: int) -> tuple[Tensor, Tensor, Tensor]:
        """Where a step's entries are `(n, K)`, which are beyond their tile's list, and their Gaussians `(n K,)`."""
        band = self.band
        positions = starts[:, None] + (band.slots + chunk * band.chunk_size)
        beyond = positions >= ends[:, None]
        ids = band.entries.index_select(0, positions.view(-1)).masked_fill_(beyond.view(-1), band.features.shape[0] - 1)
        return positions, beyond, ids

    def evaluate(self, ids: Tensor, tiles: Tensor, before: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Fill `alpha` with unclamped alphas; the Gaussians' offsets from the tiles' centres, and ln o."""
        band, n = self.band, tiles.shape[0]
        self.shape_buffers(n)
        table = band.table.index_select(1, ids)
        log_opacity = table[0].clone()
        centres = band.centres.index_select(1, tiles)
        ux = (table[1].view(n, -1) - centres[0][:, None]).view(-1)
        uy = (table[2].view(n, -1) - centres[1][:, None]).view(-1)
        ax, ay, bx, by = table[6], table[7], table[8], table[9]
        va = torch.mul(ax, ux).addcmul_(ay, uy)
        vb = torch.mul(bx, ux).addcmul_(by, uy)
        table[0].addcmul_(va, va, value=-0.5).addcmul_(vb, vb, value=-0.5)
        torch.mul(ax, va, out=table[1]).addcmul_(bx, vb)
        torch.mul(ay, va, out=table[2]).addcmul_(by, vb)
        flat = self.alpha.view(-1, band.pixels)
        torch.mm(table[:6].t(), band.monomials, out=flat)
        flat.clamp_(min=band.floor).exp_()
        F.threshold(flat, band.cut, 0.0, inplace=True)
        self.light[:, 0] = before
        return ux, uy, log_opacity

    def scan(self) -> None:
        """Fill `light` with the transmittance before each layer and after the last, from the clamped alphas."""
        alpha, light = self.alpha, self.light
        if alpha.device.type == "cpu":
            layers = light.unbind(1)
            for k, a in enumerate(alpha.unbind(1)):
                torch.addcmul(layers[k], layers[k], a, value=-1, out=layers[k + 1])
        else:
            torch.mul(torch.cumprod(1 - alpha, 1), light[:, :1], out=light[:, 1:])
        if self.band.stop is not None:  # T never grows, so cutting afterwards is cutting at each layer
            F.threshold(light, self.band.stop, 0.0, inplace=True)


class Forward(_Worker):
    """Adds the layers of a group to the sums, front to back."""

    def __init__(self, band: Band, blocks: tuple[Tensor, ...], outputs: tuple[Tensor, ...], keep: bool) -> None:
        super().__init__(band, buffers=2)
        self.blocks, self.outputs, self.keep = blocks, outputs, keep

    def __call__(self, group: Group) -> None:
        """Composite a group."""
        band, size = self.band, self.band.chunk_size
        tiles, starts, ends, chunks = group.tiles, group.starts, group.ends, group.chunks
        state = tuple(output.index_select(0, tiles) for output in self.outputs)
        rows: Tensor | None = None
        group.steps = []
        n, j = len(chunks), 0
        while chunks[0] > j:
            while chunks[n - 1] <= j:
                n -= 1
            light, median, *sums = (x[:n] for x in state)
            if self.keep:
                group.steps.append(Step(j, rows, n, light[:, 0].clone()))
            _, _, ids = self.entries(starts[:n], ends[:n], j)
            self.evaluate(ids, tiles[:n], light[:, 0])
            self.alpha.clamp_(max=ALPHA_MAX)
            self.scan()
            if band.depths is not None:
                crossing = ((self.light[:, :-1] >= 0.5) & (self.light[:, 1:] < 0.5)).to(light.dtype)
                median.baddbmm_(band.depths.index_select(0, ids).view(n, 1, size), crossing)
            weights = self.alpha.mul_(self.light[:, :-1])
            for block, total in zip(self.blocks, sums, strict=True):
                total.baddbmm_(block.index_select(0, ids).view(n, size, -1).transpose(1, 2), weights)
            light[:, 0] = self.light[:, -1]
            live = light[:, 0].amax(1) > 0
            live_count = int(live.sum())
            if live_count == 0:
                break
            if live_count < _LIVE_SHARE * n:
                self._write(tiles, state)
                kept = live.nonzero()[:, 0]
                tiles, starts, ends = (x.index_select(0, kept) for x in (tiles, starts, ends))
                state = tuple(x.index_select(0, kept) for x in state)
                rows = kept if rows is None else rows.index_select(0, kept)
                chunks = [chunks[i] for i in kept.tolist()]
                n = len(chunks)
            j += 1
        self._write(tiles, state)

    def _write(self, tiles: Tensor, state: tuple[Tensor, ...]) -> None:
        for output, value in zip(self.outputs, state, strict=True):
            output.index_copy_(0, tiles, value)


class Backward(_Worker):
    """Takes the kept steps of a group from back to front and writes the gradients of their entries."""

    def __init__(self, band: Band, grads: Tensor, behind: Tensor, rows: Tensor) -> None:
        super().__init__(band, buffers=5)
        self.grads, self.behind, self.rows = grads, behind, rows
        self.tiny = torch.finfo(rows.dtype).tiny

    def shape_buffers(self, n: int) -> None:
        """The same for the colours along g, the light behind, and the derivative of alpha where it is clamped."""
        changed = n != self.count
        super().shape_buffers(n)
        if changed:
            k, p = self.band.chunk_size, self.band.pixels
            self.value = self.memory[2][: n * k * p].view(n, k, p)
            self.later = self.memory[3][: n * (k + 1) * p].view(n, k + 1, p)
            self.slope = self.memory[4][: n * k * p].view(n, k, p)

    def __call__(self, group: Group) -> None:
        """Differentiate a group."""
        grads = self.grads.index_select(0, group.tiles)
        behind = self.behind.index_select(0, group.tiles)[:, 0]
        for step in reversed(group.steps):
            if step.rows is None:
                tiles, starts, ends = (x[: step.count] for x in (group.tiles, group.starts, group.ends))
                self._step(step, tiles, starts, ends, grads[: step.count], behind[: step.count])
            else:
                rows = step.rows[: step.count]
                tiles, starts, ends, g, later = (
                    x.index_select(0, rows) for x in (group.tiles, group.starts, group.ends, grads, behind)
                )
                self._step(step, tiles, starts, ends, g, later)
                behind.index_copy_(0, rows, later)

    def _step(self, step: Step, tiles: Tensor, starts: Tensor, ends: Tensor, grads: Tensor, behind: Tensor) -> None:
        """Gradients of one step; `behind` becomes the light behind the step's first layer."""
        band, n, size = self.band, step.count, self.band.chunk_size
        positions, beyond, ids = self.entries(starts, ends, step.chunk)
        ux, uy, log_opacity = self.evaluate(ids, tiles, step.transmittance)
        clamped = float(log_opacity.max()) > math.log(ALPHA_MAX)
        if clamped:  # alphas whose derivative is their own value; 0 where the clamp holds
            self.slope.copy_(self.alpha)
            F.threshold(self.slope, ALPHA_MAX, 0.0, inplace=True)
            torch.sub(self.alpha, self.slope, out=self.slope)
            self.alpha.clamp_(max=ALPHA_MAX)
        self.scan()
        before, after = self.light[:, :-1], self.light[:, 1:]
        weights = self.alpha.mul_(before)
        features = band.features.index_select(0, ids).view(n, size, -1)
        torch.bmm(features, grads, out=self.value)
        self.later[:, -1] = behind
        layers = self.later.unbind(1)
        for k, (w, v) in reversed(list(enumerate(zip(weights.unbind(1), self.value.unbind(1), strict=True)))):
            torch.addcmul(layers[k + 1], w, v, out=layers[k])
        behind.copy_(layers[0])
        d_features = torch.bmm(weights, grads.transpose(1, 2))
        # where T behind a layer is 0, so is the light behind it
        value = self.value.sub_(self.later[:, 1:].div_(after.clamp_(min=self.tiny)))
        if clamped:
            value.mul_(self.slope).mul_(before)
        else:
            value.mul_(weights)
        moments = torch.mm(band.monomials, value.view(-1, band.pixels).t())
        rows = torch.empty(n * size, 6 + features.shape[2], dtype=moments.dtype, device=moments.device)
        rows[:, :6] = _about_centre(moments, ux, uy).t()
        rows[:, 6:] = d_features.view(n * size, -1)
        positions.masked_fill_(beyond, self.rows.shape[0] - 1)
        self.rows.index_copy_(0, positions.view(-1), rows)


def _about_centre(moments: Tensor, ux: Tensor, uy: Tensor) -> Tensor:
    """Moments 1, x, y, xx, xy, yy about the tile's centre, in place to those about the Gaussian's."""
    m0, mx, my, mxx, mxy, myy = moments
    sx = torch.addcmul(mx, ux, m0, value=-1)
    sy = torch.addcmul(my, uy, m0, value=-1)
    mxx.addcmul_(ux, mx.add_(sx), value=-1)
    mxy.addcmul_(ux, my, value=-1).addcmul_(uy, sx, value=-1)
    myy.addcmul_(uy, my.add_(sy), value=-1)
    mx.copy_(sx)
    my.copy_(sy)
    return moments
