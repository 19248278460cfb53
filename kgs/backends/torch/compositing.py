"""Compositing in torch, for every device and dtype; the formulas are in `kgs.backends.torch`.

Tiles are the last dimension of all tensors here, and P the pixels of a tile: an operator works on the same pixel of
many tiles side by side. A row slice is made of depth slices; within one, tiles are sorted by the length of their lists
and cut into chunks: K layers of n tiles, `(K, P, n)`, as many as fit into memory.

There are no matrix products: torch may round them (`torch.set_float32_matmul_precision`, `torch.autocast`), and the
order of their sums depends on sizes. Nothing is added atomically. On a CPU the layers of a pixel are added one by one,
so that no bit of the image depends on how they were cut into chunks.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kgs.backends.row_slices import MAX_BYTES
from kgs.backends.signatures import Compositor, Images, Inputs
from kgs.geometry.covariance import footprint_table, moment_gradients
from kgs.geometry.types import ProjectedGaussians, RasterOptions

from .binning import TileCoverage, TileLists

ALPHA_MAX = 0.99


@dataclass(frozen=True)
class DeviceSettings:
    """How work is cut for a kind of device."""

    pairs: int  # of a Gaussian and a pixel in a chunk, at most
    layers: int  # entries per tile in a depth slice: few pixels need more before they are opaque
    by_layer: bool  # scans are made layer by layer: least memory is passed, and many operators are called
    may_ask: bool  # whether reading a number is cheap; on a GPU it waits until all work is done


SETTINGS = {"cpu": DeviceSettings(2**19, 192, True, True), "cuda": DeviceSettings(2**24, 192, False, False)}
_MIN_LAYERS = 8  # of a chunk with many tiles
_ARRAYS = 9  # numbers per pair that a chunk holds at the same time


class TorchCompositor(Compositor):
    """Compositing on every device and in every dtype."""

    def __init__(
        self,
        projected: ProjectedGaussians,
        features: Tensor,
        options: RasterOptions,
        median_depth: bool = False,
        chunk_size: int | None = None,
    ) -> None:
        self._settings = SETTINGS.get(features.device.type, SETTINGS["cuda"])
        tile_size = options.tile_size or 8
        number = features.element_size()
        arrays = _ARRAYS + 3 * options.absgrad
        max_bytes = options.max_bytes or MAX_BYTES
        chunk_bytes = min(self._settings.pairs * arrays * number, max_bytes // 4)
        budget = max_bytes - chunk_bytes
        # working memory of a Gaussian in a row of tiles; and in a tile: lists, sorting, gradients, sum, saved T
        width = 8 + 2 * features.shape[1] + 4 * options.absgrad + tile_size**2 // 8
        per_span = 32 + 16 * number
        per_entry = 80 + width * number
        max_spans = max(2**12, budget // (2 * per_span))
        self._coverage = TileCoverage(projected, tile_size, options.alpha_threshold, max_spans)
        self._row_slices = self._coverage.row_slices(budget, per_span, per_entry)
        self._depth_slices = self._coverage.depth_slices(self._settings.layers)
        lists_bytes = per_entry * self._coverage.num_entries + per_span * self._coverage.num_spans // 4
        self._spare = budget - lists_bytes if len(self._row_slices) == 1 else 0  # to keep alphas
        self._image_size = projected.image_size
        self._eps2d = projected.eps2d
        self._depths = projected.depths.detach() if median_depth else None
        self._cut = Cut(chunk_bytes // (arrays * number), chunk_size)
        self._thresholds = Thresholds.of(options, features.dtype)
        self._absgrad = options.absgrad
        self._kept: Any = None  # transmittance, and depth slices with their ranks

    def forward(self, inputs: Inputs, keep: bool) -> Images:
        """The images, a row slice after the other; of several none is kept."""
        keep = keep and len(self._row_slices) == 1
        results = [self._composite_rows(inputs, rows, keep) for rows in self._row_slices]
        canvases = [canvas for canvas, _ in results]
        transmittance, median, features = (torch.cat(parts, 2) for parts in zip(*canvases, strict=True))
        grid = self._coverage.grid
        size = self._image_size
        images = (to_images(features, grid, size), to_images(transmittance, grid, size), to_images(median, grid, size))
        self._kept = results[0][1] if keep else None
        return images

    def backward(
        self, inputs: Inputs, grad_features: Tensor, grad_transmittance: Tensor, needs: tuple[bool, ...]
    ) -> tuple[tuple[Tensor | None, ...], Tensor | None]:
        """The gradients, a row slice after the other; those that were not kept are composited again."""
        kept, self._kept = self._kept, None
        coverage = self._coverage
        grads = to_tiles(grad_features, coverage.grid, coverage.tile_size)
        behind = to_tiles(grad_transmittance, coverage.grid, coverage.tile_size)
        wanted = Wanted(any(needs[:3]), self._absgrad and needs[0], needs[3])
        total = grads.new_zeros(coverage.ids.shape[0], wanted.columns(grads.shape[0]))  # of each Gaussian
        for begin, end in self._row_slices:
            transmittance, slices = self._composite_rows(inputs, (begin, end), keep=True)[1] if kept is None else kept
            kept = None
            tiles = slice(begin * coverage.grid[1], end * coverage.grid[1])
            later = torch.where(transmittance[0] > 0, behind[0, :, tiles], 0.0)
            while slices:
                (low, high), part = slices.pop()
                total[low:high] += part.differentiate(grads[:, :, tiles], later, wanted)
        moments, absolute, features = total.split(wanted.widths(grads.shape[0]), 1)
        gradients: tuple[Tensor | None, ...] = (None, None, None, features)
        if wanted.moments:
            factors, opacities = (x.index_select(0, coverage.ids) for x in inputs[1:3])
            gradients = (*moment_gradients(moments, factors, opacities, self._eps2d), features)

        def spread(value: Tensor) -> Tensor:
            """From the Gaussians that reach a tile to all, 0 for the others."""
            return value.new_zeros(inputs[0].shape[0], *value.shape[1:]).index_copy_(0, coverage.ids, value)

        needed = zip(gradients, needs, strict=True)
        return (
            tuple(spread(x) if need and x is not None else None for x, need in needed),
            spread(absolute) if wanted.absolute else None,
        )

    def _composite_rows(self, inputs: Inputs, rows: tuple[int, int], keep: bool) -> tuple["Canvas", Any]:
        """A row slice, one depth slice after the other until all pixels are opaque, and what `backward` needs."""
        coverage = self._coverage
        tiles = (rows[1] - rows[0]) * coverage.grid[1]
        pixels = coverage.tile_size**2
        like, features = inputs[0], inputs[3]
        transmittance = like.new_ones(1, pixels, tiles)
        median = like.new_zeros(0 if self._depths is None else 1, pixels, tiles)
        canvas = (transmittance, median, like.new_zeros(features.shape[1], pixels, tiles))
        spans = coverage.spans(*rows)
        spare = self._spare
        live = None
        slices: list[tuple[tuple[int, int], DepthSlice]] = []
        for ranks in self._depth_slices:
            lists = coverage.lists(spans, *rows, ranks, live)
            part = DepthSlice(lists, self._gaussians(inputs, lists.ids), self._thresholds, self._settings, self._cut)
            keep_alphas = keep and part.alpha_bytes <= spare
            spare -= part.alpha_bytes * keep_alphas
            part.composite(canvas, keep, keep_alphas)
            if keep:
                slices.append((ranks, part))
            if ranks != self._depth_slices[-1]:
                live = (transmittance[0] > 0).any(0)
                if not bool(live.any()):
                    break
        return canvas, (transmittance, slices) if keep else None

    def _gaussians(self, inputs: Inputs, ids: Tensor) -> "Columns":
        """What chunks need of some Gaussians, followed by a dummy that is never seen."""
        means2d, factors, opacities, features = (x.index_select(0, ids) for x in inputs)
        table = F.pad(footprint_table(means2d, factors, opacities, self._eps2d), (0, 1))
        table[0, -1] = -torch.inf
        depths = None if self._depths is None else F.pad(self._depths.index_select(0, ids), (0, 1))
        return Columns(table, F.pad(features.t(), (0, 1)), depths)


Canvas = tuple[Tensor, Tensor, Tensor]  # transmittance (1, P, T), median depth (1 or 0, P, T), features (F, P, T)


@dataclass(frozen=True)
class Wanted:
    """What a backward pass sums up for each Gaussian, in this order."""

    moments: bool  # six moments of dL/d ln alpha about its centre
    absolute: bool  # absolute values of what pixels add to dL/d mean, x and y
    features: bool  # dL/d features

    def widths(self, features: int) -> list[int]:
        """The numbers of each."""
        return [6 * self.moments, 2 * self.absolute, features * self.features]

    def columns(self, features: int) -> int:
        """All together."""
        return sum(self.widths(features))


@dataclass(frozen=True, eq=False)
class Columns:
    """A column of numbers for each Gaussian of a depth slice."""

    table: Tensor  # (7, n + 1), see `kgs.geometry.covariance.footprint_table`
    features: Tensor  # (F, n + 1)
    depths: Tensor | None  # (n + 1,), where the median depth is wanted


@dataclass(frozen=True)
class Thresholds:
    """What counts as a layer; torch's threshold keeps what is strictly larger than a number."""

    floor: float  # of the exponent: exp is slow where its result is denormal
    alpha: float  # smaller alphas, and those at the floor, are 0
    transmittance: float  # transmittance below this counts as 0

    @classmethod
    def of(cls, options: RasterOptions, dtype: torch.dtype) -> "Thresholds":
        """Those of `kgs.RasterOptions`."""
        threshold = options.alpha_threshold
        stop = options.transmittance_stop
        floor = math.log(threshold) - 20 if threshold else math.log(torch.finfo(dtype).tiny) + 8
        alpha = _below(max(threshold, 1.01 * math.exp(floor)), dtype)
        return cls(floor, alpha, _below(stop, dtype) if stop else -1.0)


@dataclass(eq=False)
class Chunk:
    """K layers of n tiles, and what the backward pass needs of them."""

    tiles: slice  # of the sorted tiles
    first: int  # position of the first layer in the lists
    layers: int  # K
    before: Tensor | None = field(default=None, repr=False)  # transmittance before the first layer, (P, n)
    alpha: Tensor | None = field(default=None, repr=False)  # (K, P, n), where there is memory to keep it
    ended: bool = False  # whether a pixel's transmittance may have fallen below the stop


@dataclass(frozen=True)
class Cut:
    """How lists are cut into chunks."""

    pairs: int  # of a Gaussian and a pixel, at most
    layers: int | None  # K; None chooses

    def __call__(self, lengths: Sequence[int], pixels: int) -> list[Chunk]:
        """The chunks of tiles with lists of these lengths, in descending order."""
        max_tiles = max(1, self.pairs // (pixels * (self.layers or _MIN_LAYERS)))
        chunks = []
        for begin in range(0, len(lengths), max_tiles):
            end = min(begin + max_tiles, len(lengths))
            first = 0
            while first < lengths[begin]:
                while lengths[end - 1] <= first:
                    end -= 1
                # as many layers as a quarter of the lists still has: the longest take another chunk, with few tiles
                fitting = max(self.pairs // (pixels * (end - begin)), 1)
                wanted = max(lengths[begin + (end - begin) // 4] - first, fitting // 4)
                layers = self.layers or min(wanted, fitting, lengths[begin] - first)
                chunks.append(Chunk(slice(begin, end), first, layers))
                first += layers
        return chunks


class DepthSlice:
    """The tiles of a row slice with their entries of a depth slice, the longest list first."""

    def __init__(
        self, lists: TileLists, gaussians: Columns, thresholds: Thresholds, settings: DeviceSettings, cut: Cut
    ) -> None:
        self.lists = lists
        self._gaussians = gaussians
        self._thresholds = thresholds
        self._settings = settings
        # Sums along the layers of a GPU are not deterministic for torch
        self._by_layer = settings.by_layer or torch.are_deterministic_algorithms_enabled()
        lengths, order = torch.sort(lists.offsets.diff(), descending=True, stable=True)
        counts = [length for length in lengths.tolist() if length > 0]
        self._tiles = order[: len(counts)]
        self._starts = lists.offsets[:-1].index_select(0, self._tiles)
        self._ends = lists.offsets[1:].index_select(0, self._tiles)
        pixels = lists.tile_size**2
        self._chunks = cut(counts, pixels)
        pairs = pixels * sum(chunk.layers * (chunk.tiles.stop - chunk.tiles.start) for chunk in self._chunks)
        self.alpha_bytes = pairs * gaussians.table.element_size()  # to keep all alphas
        self._entries = F.pad(lists.entries, (0, 1), value=lists.ids.shape[0])
        # coordinates of the columns and rows of pixels of each tile, (side, tiles)
        tile = self._tiles + lists.first_tile
        side = torch.arange(lists.tile_size, device=order.device)
        row = torch.div(tile, lists.grid[1], rounding_mode="floor")
        corner = torch.stack([tile - row * lists.grid[1], row % lists.grid[0]]) * lists.tile_size
        self._columns, self._rows = (corner[:, None] + side[:, None]).to(gaussians.table.dtype)
        self._clamps = self._may(gaussians.table[0] > math.log(ALPHA_MAX))

    def composite(self, canvas: Canvas, keep: bool, keep_alphas: bool) -> None:
        """Add the layers to the tiles of a canvas, front to back; with `keep` chunks keep what `backward` needs."""
        state = [x.index_select(2, self._tiles) for x in canvas]
        for chunk in self._chunks:
            transmittance, median, features = (x[:, :, chunk.tiles] for x in state)
            _, ids = self._entries_of(chunk)
            alpha = self._alphas(*self._offsets(chunk, ids))
            layers = self._transmittances(alpha, transmittance[0])
            ended = self._may(layers[-1] <= self._thresholds.transmittance)
            if ended:  # T never grows, so cutting afterwards is cutting at each layer
                F.threshold(layers, self._thresholds.transmittance, 0.0, inplace=True)
            if keep:
                chunk.before = transmittance[0].clone()
                chunk.alpha = alpha if keep_alphas else None
                chunk.ended = ended
            if self._gaussians.depths is not None:
                crossing = (layers[:-1] >= 0.5) & (layers[1:] < 0.5)
                depths = self._gaussians.depths.index_select(0, ids.view(-1)).view_as(ids)
                median += (crossing * depths[:, None]).sum(0)
            self._add(features, ids, alpha * layers[:-1])
            transmittance[0] = layers[-1]
        for whole, part in zip(canvas, state, strict=True):
            whole.index_copy_(2, self._tiles, part)

    def differentiate(self, grads: Tensor, behind: Tensor, wanted: Wanted) -> Tensor:
        """What each Gaussian gets of what is wanted, `(n, columns)`.

        `grads` are dL/d features of the pixels, `(F, P, T)`. `behind` is V behind the last layer, `(P, T)`, and becomes
        V before the first.
        """
        lists = self.lists
        width = wanted.columns(grads.shape[0])
        own_grads = grads.index_select(2, self._tiles)
        own_behind = behind.index_select(1, self._tiles)
        rows = grads.new_zeros(self._entries.shape[0], width)  # of each entry, and one for what is beyond the lists
        while self._chunks:
            chunk = self._chunks.pop()  # whose memory is free afterwards
            positions, ids = self._entries_of(chunk)
            pixels = own_grads[:, :, chunk.tiles]
            sums = self._chunk_sums(chunk, ids, pixels, own_behind[:, chunk.tiles], wanted)
            rows.index_copy_(0, positions.view(-1), torch.stack(sums, -1).view(-1, width))
        behind.index_copy_(1, self._tiles, own_behind)
        # each entry once, in the order of the Gaussians: a sum in fixed order, without atomics
        return F.embedding_bag(lists.by_gaussian, rows, lists.gaussian_offsets, mode="sum")

    def _chunk_sums(self, chunk: Chunk, ids: Tensor, grads: Tensor, behind: Tensor, wanted: Wanted) -> list[Tensor]:
        """What is wanted of the entries of a chunk, each `(K, n)`; `behind` moves before the chunk."""
        table, dx, dy = self._offsets(chunk, ids)
        alpha = self._alphas(table, dx, dy) if chunk.alpha is None else chunk.alpha
        assert chunk.before is not None
        transmittance = self._transmittances(alpha, chunk.before)
        if chunk.ended:  # nothing counts behind the stop
            F.threshold(transmittance, self._thresholds.transmittance, 0.0, inplace=True)
            alpha.mul_(transmittance[:-1].sign())
        weights = alpha * transmittance[:-1]
        sums = []
        if wanted.moments:
            value = torch.zeros_like(alpha)  # c . g
            for color, grad in zip(self._features(ids), grads, strict=True):
                value.addcmul_(color[:, None], grad)
            later = self._later(alpha, transmittance, weights, value, behind)
            behind.copy_(later[0])
            value.sub_(later[1:]).mul_(weights)
            if self._clamps:  # no derivative where alpha is held at its maximum
                value.mul_((ALPHA_MAX - alpha).sign_())
            absolute = _absolute(value, table, dx, dy) if wanted.absolute else []
            sums += _moments(value, dx, dy) + absolute
        if wanted.features:
            product = torch.empty_like(weights)
            sums += [torch.mul(weights, grad, out=product).sum(1) for grad in grads]
        return sums

    def _entries_of(self, chunk: Chunk) -> tuple[Tensor, Tensor]:
        """Where the entries of a chunk are in the lists, and their Gaussians, `(K, n)`; beyond a list the dummy."""
        layers = torch.arange(chunk.first, chunk.first + chunk.layers, device=self._starts.device)
        positions = self._starts[chunk.tiles] + layers[:, None]
        positions = positions.where(positions < self._ends[chunk.tiles], self._entries.shape[0] - 1)
        return positions, self._entries.index_select(0, positions.view(-1)).view_as(positions)

    def _features(self, ids: Tensor) -> Tensor:
        """`(F, K, n)`."""
        return self._gaussians.features.index_select(1, ids.view(-1)).view(-1, *ids.shape)

    def _offsets(self, chunk: Chunk, ids: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Columns of the Gaussians `(7, K, n)`, and from these to columns and rows of pixels, `(K, side, n)`."""
        table = self._gaussians.table.index_select(1, ids.view(-1)).view(-1, *ids.shape)
        dx = self._columns[:, chunk.tiles] - table[1][:, None]
        dy = self._rows[:, chunk.tiles] - table[2][:, None]
        return table, dx, dy

    def _alphas(self, table: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
        """Alphas `(K, P, n)`: the exponent is the sum of two squares, each linear in x and y."""
        log_opacity, _, _, ax, ay, bx, by = table[:, :, None]
        a = (ax * dx)[:, None] + (ay * dy)[:, :, None]
        alpha = torch.addcmul(log_opacity[:, None], a, a, value=-0.5)
        b = torch.add((bx * dx)[:, None], (by * dy)[:, :, None], out=a)
        alpha.addcmul_(b, b, value=-0.5).clamp_(min=self._thresholds.floor).exp_()
        if self._clamps:
            alpha.clamp_(max=ALPHA_MAX)
        return F.threshold(alpha, self._thresholds.alpha, 0.0, inplace=True).flatten(1, 2)

    def _transmittances(self, alpha: Tensor, before: Tensor) -> Tensor:
        """The transmittance before each layer and after the last, `(K + 1, P, n)`, without the stop."""
        if not self._by_layer:
            return torch.cat([before[None], 1 - alpha]).cumprod_(0)
        transmittance = alpha.new_empty(alpha.shape[0] + 1, *alpha.shape[1:])
        layers = transmittance.unbind(0)
        layers[0].copy_(before)
        for k, layer in enumerate(alpha.unbind(0)):
            torch.addcmul(layers[k], layers[k], layer, value=-1, out=layers[k + 1])
        return transmittance

    def _add(self, features: Tensor, ids: Tensor, weights: Tensor) -> None:
        """Add the layers `(K, P, n)` to the sums `(F, P, n)`."""
        colors = self._features(ids)
        if self._by_layer:
            for color, weight in zip(colors.unbind(1), weights.unbind(0), strict=True):
                features.addcmul_(color[:, None], weight)
        else:
            for total, color in zip(features, colors, strict=True):
                total += (weights * color[:, None]).sum(0)

    def _later(self, alpha: Tensor, transmittance: Tensor, weights: Tensor, value: Tensor, behind: Tensor) -> Tensor:
        """V of each layer and behind the last, `(K + 1, P, n)`."""
        if not self._by_layer:
            # what comes from behind a layer over the transmittance there; both are 0 behind the stop
            contributions = torch.cat([weights * value, (transmittance[-1] * behind)[None]])
            behind_each = contributions.flip(0).cumsum_(0).flip(0)
            return behind_each.div_(transmittance.clamp_(min=torch.finfo(transmittance.dtype).tiny))
        later = torch.empty_like(transmittance)
        layers = later.unbind(0)
        layers[-1].copy_(behind)
        for k in reversed(range(alpha.shape[0])):
            torch.lerp(layers[k + 1], value[k], alpha[k], out=layers[k])
        return later

    def _may(self, condition: Tensor) -> bool:
        """Whether a condition holds anywhere; True, without looking, where reading a number is expensive."""
        return not self._settings.may_ask or bool(condition.any())


def _moments(slope: Tensor, dx: Tensor, dy: Tensor) -> list[Tensor]:
    """Sums over the pixels of `slope` `(K, P, n)` times 1, x, y, xx, xy, yy about the Gaussian's centre, `(K, n)`.

    `slope` is overwritten.
    """
    square = slope.unflatten(1, (dy.shape[1], dx.shape[1]))
    columns = square.sum(1)
    rows = square.sum(2)
    turning = square.mul_(dx[:, None]).sum(2)
    x = columns * dx
    y = rows * dy
    return [columns.sum(1), x.sum(1), y.sum(1), (x * dx).sum(1), (turning * dy).sum(1), (y * dy).sum(1)]


def _absolute(slope: Tensor, table: Tensor, dx: Tensor, dy: Tensor) -> list[Tensor]:
    """Sums over the pixels of |slope d(ln alpha)/d(mean)|, x and y, `(K, n)`."""
    _, _, _, ax, ay, bx, by = table[:, :, None]
    a = (ax * dx)[:, None] + (ay * dy)[:, :, None]
    b = (bx * dx)[:, None] + (by * dy)[:, :, None]
    square = slope.unflatten(1, (dy.shape[1], dx.shape[1]))
    vectors = ((ax, bx), (ay, by))
    return [(square * (a * u[:, None] + b * v[:, None])).abs_().sum((1, 2)) for u, v in vectors]


def to_images(tiles: Tensor, grid: tuple[int, int], image_size: tuple[int, int]) -> Tensor:
    """`(F, P, C * rows * columns)` to `(C, F, H, W)`."""
    rows, columns = grid
    height, width = image_size
    side = math.isqrt(tiles.shape[1])
    channels = tiles.shape[0]
    cameras = tiles.shape[2] // (rows * columns)
    images = tiles.view(channels, side, side, cameras, rows, columns).permute(3, 0, 4, 1, 5, 2)
    return images.reshape(cameras, channels, rows * side, columns * side)[:, :, :height, :width].clone()


def to_tiles(images: Tensor, grid: tuple[int, int], side: int) -> Tensor:
    """The inverse of `to_images`; pixels beyond the image are 0."""
    rows, columns = grid
    cameras, channels, height, width = images.shape
    images = F.pad(images, (0, columns * side - width, 0, rows * side - height))
    tiles = images.view(cameras, channels, rows, side, columns, side).permute(1, 3, 5, 0, 2, 4)
    return tiles.reshape(channels, side * side, cameras * rows * columns)


def _below(value: float, dtype: torch.dtype) -> float:
    """The largest number below `value`."""
    return float(np.nextafter(np.dtype(str(dtype).removeprefix("torch.")).type(value), 0))
