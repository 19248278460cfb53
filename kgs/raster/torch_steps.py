"""A step of compositing, forward and backward, for one thread; formulas as in `kgs.raster`, groups as in `tasks`."""

import torch
import torch.nn.functional as F
from torch import Tensor

from .tasks import ALPHA_MAX, Group, Slice, Step

_LIVE_SHARE = 0.8  # a group is compacted when fewer of its tiles than this still let light through


class _Worker:
    """Buffers of one thread; layer k of all tiles of a step is one contiguous slab, for scans over long vectors."""

    def __init__(self, part: Slice, buffers: int) -> None:
        self.part = part
        largest = max((len(group.chunks) for group in part.groups), default=0)
        size = largest * (part.chunk_size + 1) * part.pixels
        self.memory = [part.table.new_empty(size) for _ in range(buffers)]

    def buffer(self, index: int, layers: int, n: int) -> Tensor:
        """One of the buffers as `(layers, n, P)`."""
        return self.memory[index][: layers * n * self.part.pixels].view(layers, n, self.part.pixels)

    def entries(self, starts: Tensor, ends: Tensor, chunk: int) -> tuple[Tensor, Tensor, Tensor]:
        """Where a step's entries are `(K, n)`, which are beyond their tile's list, and their Gaussians `(K n,)`."""
        part = self.part
        positions = starts + (part.slots + chunk * part.chunk_size)[:, None]
        beyond = positions >= ends
        ids = part.entries.index_select(0, positions.view(-1)).masked_fill_(beyond.view(-1), part.features.shape[0] - 1)
        return positions, beyond, ids

    def offsets(self, places: Tensor, tiles: Tensor) -> tuple[Tensor, Tensor]:
        """From the centres of n tiles to Gaussians at `places` `(2, K n)`."""
        ux, uy = (places.view(2, -1, tiles.shape[0]) - self.part.centres.index_select(1, tiles)[:, None]).view(2, -1)
        return ux, uy

    def evaluate(self, ids: Tensor, tiles: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
        """Fill `alpha` `(K, n, P)`; returns the offsets."""
        part = self.part
        table = part.table.index_select(1, ids)
        ux, uy = self.offsets(table[1:3], tiles)
        ax, ay, bx, by = table[6:]
        va, vb = torch.mul(ax, ux).addcmul_(ay, uy), torch.mul(bx, ux).addcmul_(by, uy)
        table[0].addcmul_(va, va, value=-0.5).addcmul_(vb, vb, value=-0.5)
        torch.mul(ax, va, out=table[1]).addcmul_(bx, vb)
        torch.mul(ay, va, out=table[2]).addcmul_(by, vb)
        flat = alpha.view(-1, part.pixels)
        torch.mm(table[:6].t(), part.monomials, out=flat)
        flat.clamp_(min=part.floor).exp_()
        if part.clamps:
            flat.clamp_(max=ALPHA_MAX)
        F.threshold(flat, part.cut, 0.0, inplace=True)
        return ux, uy

    def scan(self, alpha: Tensor, before: Tensor) -> Tensor:
        """The transmittance before each layer and after the last, `(K + 1, n, P)`, without the stop."""
        light = self.buffer(0, alpha.shape[0] + 1, alpha.shape[1])
        light[0] = before
        if self.part.by_layer:
            layers = light.unbind(0)
            for k, a in enumerate(alpha.unbind(0)):
                torch.addcmul(layers[k], layers[k], a, value=-1, out=layers[k + 1])
        else:
            torch.mul(torch.cumprod(1 - alpha, 0), light[:1], out=light[1:])
        return light


class Forward(_Worker):
    """Adds the layers of a group to the sums, front to back."""

    def __init__(self, part: Slice, outputs: tuple[Tensor, ...], keep: bool, keep_alphas: bool) -> None:
        super().__init__(part, buffers=2)
        self.outputs, self.keep, self.keep_alphas = outputs, keep, keep_alphas
        self.blocks = part.features.split(3, dim=1)

    def __call__(self, group: Group) -> None:
        """Composite a group."""
        part, size = self.part, self.part.chunk_size
        tiles, starts, ends, chunks = group.tiles, group.starts, group.ends, group.chunks
        state = [output.index_select(0, tiles) for output in self.outputs]
        rows: Tensor | None = None
        group.steps, n, j = [], len(chunks), 0
        while chunks[0] > j:
            while chunks[n - 1] <= j:
                n -= 1
            light, median, *sums = (x[:n] for x in state)
            _, _, ids = self.entries(starts[:n], ends[:n], j)
            buffer = self.buffer(1, size, n)
            alpha = torch.empty_like(buffer) if self.keep_alphas else buffer
            self.evaluate(ids, tiles[:n], alpha)
            layers = self.scan(alpha, light[:, 0])
            # T never grows, so cutting afterwards is cutting at each layer
            ended = float(layers[-1].min()) <= part.stop
            if ended:
                F.threshold(layers, part.stop, 0.0, inplace=True)
            if self.keep:
                group.steps.append(Step(j, rows, n, light[:, 0].clone(), alpha if self.keep_alphas else None, ended))
            if part.depths is not None:
                crossing = (layers[:-1] >= 0.5) & (layers[1:] < 0.5)
                depths = part.depths.index_select(0, ids).view(size, n, 1)
                median[:, 0] += torch.where(crossing, depths, 0.0).sum(
                    0
                )  # a depth that is not finite stays in its pixels
            weights = torch.mul(alpha, layers[:-1], out=buffer).transpose(0, 1)
            for block, total in zip(self.blocks, sums, strict=True):
                total.baddbmm_(block.index_select(0, ids).view(size, n, -1).permute(1, 2, 0), weights)
            light[:, 0] = layers[-1]
            if ended:
                kept = (light[:, 0].amax(1) > 0).nonzero()[:, 0]
                if len(kept) == 0:
                    break
                if len(kept) < _LIVE_SHARE * n:
                    self._write(tiles, state)
                    tiles, starts, ends, *state = (x.index_select(0, kept) for x in (tiles, starts, ends, *state))
                    rows = kept if rows is None else rows.index_select(0, kept)
                    chunks = [chunks[i] for i in kept.tolist()]
                    n = len(chunks)
            j += 1
        self._write(tiles, state)

    def _write(self, tiles: Tensor, state: list[Tensor]) -> None:
        for output, value in zip(self.outputs, state, strict=True):
            output.index_copy_(0, tiles, value)


class Backward(_Worker):
    """Takes the kept steps of a group from back to front and writes the gradients of their entries to `rows`.

    There is one row per entry, and a last one that takes what is thrown away: six moments where `moments`, for geometry
    and opacities, and F numbers where `features`. `grads` are dL/d sums, `(T, F, P)`; `behind` is V behind the last
    layer, `(T, 1, P)`, and becomes V before the first.
    """

    def __init__(self, part: Slice, grads: Tensor, behind: Tensor, rows: Tensor, moments: bool, features: bool) -> None:
        super().__init__(part, buffers=5 if moments else 3)
        self.grads, self.behind, self.rows, self.moments, self.features = grads, behind, rows, moments, features
        self.colors = part.features.t().contiguous()

    def __call__(self, group: Group) -> None:
        """Differentiate a group."""
        grads, behind = (x.index_select(0, group.tiles) for x in (self.grads, self.behind[:, 0]))
        for step in reversed(group.steps):
            columns = [group.tiles, group.starts, group.ends, grads, behind]
            if step.rows is None:
                self._step(step, *(x[: step.count] for x in columns))
            else:
                rows = step.rows[: step.count]
                columns = [x.index_select(0, rows) for x in columns]
                self._step(step, *columns)
                behind.index_copy_(0, rows, columns[-1])
        self.behind.index_copy_(0, group.tiles, behind[:, None])

    def _step(self, step: Step, tiles: Tensor, starts: Tensor, ends: Tensor, grads: Tensor, behind: Tensor) -> None:
        """Gradients of one step; `behind`, V behind it, becomes V before the step, see `kgs.raster`."""
        part, n, size = self.part, step.count, self.part.chunk_size
        positions, beyond, ids = self.entries(starts, ends, step.chunk)
        alpha = self.buffer(1, size, n) if step.alpha is None else step.alpha
        if step.alpha is None:
            ux, uy = self.evaluate(ids, tiles, alpha)
        else:
            ux, uy = self.offsets(part.table[1:3].index_select(1, ids), tiles)
        light = self.scan(alpha, step.transmittance)
        if step.ended:
            F.threshold(light, part.stop, 0.0, inplace=True)
        weights = torch.mul(alpha, light[:-1], out=self.buffer(2, size, n))
        rows = self.rows.new_empty(n * size, self.rows.shape[1])
        if self.features:
            d_features = torch.bmm(weights.transpose(0, 1), grads.transpose(1, 2))
            rows[:, rows.shape[1] - d_features.shape[2] :] = d_features.transpose(0, 1).reshape(n * size, -1)
        if self.moments:
            value = self.buffer(3, size, n).zero_()
            for color, grad in zip(self.colors.index_select(1, ids).view(-1, size, n, 1), grads.unbind(1), strict=True):
                value.addcmul_(color, grad)
            later = self._scan_back(alpha, light, weights, value, behind, step.ended)
            behind.copy_(later[0])
            value.sub_(later[1:]).mul_(weights)
            if part.clamps:  # no derivative where alpha is held at its maximum
                value.mul_(torch.sub(ALPHA_MAX, alpha, out=self.buffer(0, size, n)).sign_())
            moments = torch.mm(part.monomials, value.view(-1, part.pixels).t())
            rows[:, :6] = _about_centre(moments, ux, uy).t()
        positions.masked_fill_(beyond, self.rows.shape[0] - 1)
        self.rows.index_copy_(0, positions.view(-1), rows)

    def _scan_back(
        self, alpha: Tensor, light: Tensor, weights: Tensor, value: Tensor, behind: Tensor, ended: bool
    ) -> Tensor:
        """V of each layer and behind the last, `(K + 1, n, P)`; `light` is used up."""
        later = self.buffer(4, alpha.shape[0] + 1, alpha.shape[1])
        if self.part.by_layer:
            later[-1] = behind
            values, alphas, layers = value.unbind(0), alpha.unbind(0), later.unbind(0)
            reached = light[1:].sign_().unbind(0) if ended else None
            for k in reversed(range(len(values))):
                if reached is not None:
                    layers[k + 1].mul_(reached[k])
                torch.lerp(layers[k + 1], values[k], alphas[k], out=layers[k])
        else:  # the light that comes from behind a layer over the light that gets there; both are 0 behind the end
            torch.mul(weights, value, out=later[:-1])
            torch.mul(light[-1], behind, out=later[-1])
            torch.div(later.flip(0).cumsum(0).flip(0), light.clamp_(min=torch.finfo(light.dtype).tiny), out=later)
        return later


def _about_centre(moments: Tensor, ux: Tensor, uy: Tensor) -> Tensor:
    """Moments 1, x, y, xx, xy, yy about the tile's centre, in place to those about the Gaussian's."""
    m0, mx, my, mxx, mxy, myy = moments
    sx, sy = torch.addcmul(mx, ux, m0, value=-1), torch.addcmul(my, uy, m0, value=-1)
    mxx.addcmul_(ux, mx.add_(sx), value=-1)
    mxy.addcmul_(ux, my, value=-1).addcmul_(uy, sx, value=-1)
    myy.addcmul_(uy, my.add_(sy), value=-1)
    mx.copy_(sx)
    my.copy_(sy)
    return moments
