r"""Front-to-back compositing of binned Gaussians, with an analytic backward pass.

For the layers k = 1, 2, ... of a pixel, nearest first (Kerbl et al. 2023, eq. 3)

    alpha_k = min(0.99, o_k exp(-q_k / 2)),   T_1 = 1,   T_{k+1} = T_k (1 - alpha_k),
    C = sum_k w_k c_k + T_end background,   w_k = T_k alpha_k

with alpha below `alpha_threshold` taken as 0, and T below `transmittance_stop` taken as 0 from then on. Both rules act
on each pixel and layer alone, so the image does not depend on tiles or chunks.

How it is computed. K consecutive entries of a tile are a chunk; the same chunk of many tiles is a step. In coordinates
relative to the tile's centre the exponent is a quadratic polynomial of the pixel, so a step is one matrix product of
six coefficients an entry with six monomials a pixel, an exponential, a scan over K, and one product with the colours.
T at the beginning of each step is kept and, where memory allows, the alphas; else these are computed again. The
backward pass visits the steps from back to front and carries V_k, the colour along g that shows from layer k on, as if
no light had been lost before it:

    V_k = alpha_k (c_k . g) + (1 - alpha_k) V_{k+1},   V_end = g_T,   dL/d ln alpha_k = w_k (c_k . g - V_{k+1})

and V_{k+1} = 0 where layer k ends the light. V is a mean of colours: no sum grows large, nothing is divided by
1 - alpha. What a Gaussian gets from a tile are the six moments of that derivative over the pixels, again one matrix
product; they are shifted to its centre and summed over its tiles.

Where lists are long, the layers are taken in bands, nearest first: lists are made for the tiles alone that still have
light, so that what is hidden is neither listed nor sorted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from kgs.covariance import columns, variances, whitening
from kgs.full_precision import full_precision
from kgs.types import ProjectedGaussians, TileBins

from .tasks import Band, Rules, choose_chunk_size
from .tiles import TileSpans, tile_spans

__all__ = ["Composited", "composite"]

_LAYERS = 192  # Gaussians a tile in a band of layers: few see more before their light is gone
Layers = tuple[tuple[int, int], Band]  # ranks, and the band of their lists


@dataclass(frozen=True)
class Composited:
    """The sums over layers, before background and normalisation.

    Args:
        features: sum of w times features, `(C, F, H, W)`.
        transmittance: T behind the last layer, `(C, 1, H, W)`.
        median_depth: `(C, 1, H, W)` without gradient, or None.
    """

    features: Tensor
    transmittance: Tensor
    median_depth: Tensor | None


def composite(
    projected: ProjectedGaussians,
    features: Tensor,
    *,
    tile_size: int = 8,
    alpha_threshold: float = 1 / 255,
    transmittance_stop: float = 1e-4,
    median_depth: bool = False,
    max_bytes: int = 2**30,
    chunk_size: int | None = None,
) -> Composited:
    """Composite features of projected Gaussians over all pixels of all cameras.

    Differentiable once with respect to `features` and `projected.means2d`, `factors` and `opacities`.

    Args:
        projected: M visible pairs (camera, Gaussian).
        features: what to accumulate, `(M, F)`: colours, depths, anything.
        tile_size: side of the square tiles in pixels; changes the speed, and the image only by rounding.
        alpha_threshold: alphas below are skipped, in [0, 1); the error is at most the number of layers times it.
        transmittance_stop: T below counts as 0, in [0, 1); the error is at most it.
        median_depth: also find the depth at which T falls below one half.
        max_bytes: bound for the working memory; beyond it the image is done in bands, and the backward pass
            recomputes each band.
        chunk_size: entries of a tile processed at once; None chooses by the length of the lists.

    Raises:
        ValueError: an option is out of range, or one row of tiles alone exceeds `max_bytes`.
    """
    check_options(tile_size, alpha_threshold, transmittance_stop, chunk_size)
    inputs = (projected.means2d, projected.factors, projected.opacities, features)
    keep = torch.is_grad_enabled() and any(x.requires_grad for x in inputs)
    with torch.no_grad():
        spans = tile_spans(projected, tile_size, alpha_threshold)
    per_entry = bytes_per_entry(features.shape[1], tile_size, features.dtype)
    bands = spans.bands(max(1, max_bytes // per_entry))
    left = max_bytes - per_entry * int(spans.entries_per_row.sum()) if len(bands) == 1 else 0
    size = chunk_size or choose_chunk_size(spans)
    rules = Rules(alpha_threshold, transmittance_stop, median_depth, size, alpha_bytes=left)
    sums, transmittance, median = _Composite.apply(*inputs, projected, spans, bands, rules, keep)
    return Composited(sums, transmittance, median if median_depth else None)


def bytes_per_entry(width: int, tile_size: int, dtype: torch.dtype) -> int:
    """Working memory for one Gaussian in one tile: lists and sorting, gradients with their sum, and saved light."""
    return 80 + (8 + 2 * width + tile_size**2 // 8) * dtype.itemsize


@dataclass(frozen=True)
class _Passes:
    """Both passes over a range of rows of tiles: a band of layers after the other, nearest first, while light is left.

    Lists are made for the tiles alone that the bands before have left light in.
    """

    inputs: tuple[Tensor, ...]  # means2d, factors, opacities, features
    projected: ProjectedGaussians
    spans: TileSpans
    rules: Rules

    def forward(self, rows: tuple[int, int], keep: bool) -> tuple[tuple[Tensor, Tensor, Tensor], list[Layers]]:
        """Sums, transmittance and median depth of the tiles, `(T, _, P)`; and what `backward` wants."""
        sums: tuple[Tensor, ...] = ()
        live, layers, rules = None, [], self.rules
        for ranks in self.spans.depth_ranges(_LAYERS):
            band = self._band(self.spans.bin(*rows, ranks, live), ranks, rules)
            sums = sums or band.blank()
            kept_bytes = band.forward(sums, keep)
            rules = replace(rules, alpha_bytes=rules.alpha_bytes - kept_bytes)
            if keep:
                layers.append((ranks, band))
            live = sums[0].amax((1, 2)) > 0
            if ranks[1] < self.spans.ids.shape[0] and not bool(live.any()):
                break
        transmittance, median, *features = sums
        return (torch.cat(features, 1), transmittance, median), layers

    def backward(
        self, layers: list[Layers], grads: Tensor, behind: Tensor, total: Tensor, *, moments: bool, features: bool
    ) -> None:
        """Add to `total` what each Gaussian gets, see `Band.backward`; `behind` is used up."""
        for (begin, end), band in reversed(layers):
            total[begin:end] += band.backward(grads, behind, moments=moments, features=features)

    def _band(self, bins: TileBins, ranks: tuple[int, int], rules: Rules) -> Band:
        """A band with what its steps need of each Gaussian, and a dummy at the end that has no effect."""
        means2d, factors, opacities, features = (x.index_select(0, bins.ids) for x in self.inputs)
        table = F.pad(_table(means2d, factors, opacities, self.projected.eps2d), (0, 1))
        table[0, -1] = -torch.inf
        depths: Tensor | None = None
        if rules.median_depth:
            depths = F.pad(self.projected.depths.detach().index_select(0, bins.ids), (0, 1))
        features = torch.cat([features, features.new_zeros(1, features.shape[1])])
        return Band(table, features, depths, bins, rules)


class _Composite(torch.autograd.Function):
    """All cameras at once; in bands of tile rows where the lists of all would exceed the byte budget.

    One band is kept for the backward pass, several are made again there.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        factors: Tensor,
        opacities: Tensor,
        features: Tensor,
        projected: ProjectedGaussians,
        spans: TileSpans,
        bands: list[tuple[int, int]],
        rules: Rules,
        keep: bool,
    ) -> tuple[Tensor, ...]:
        inputs = (means2d, factors, opacities, features)
        passes = _Passes(inputs, projected, spans, rules)
        parts, kept = [], None
        with full_precision(means2d.device):
            for rows in bands:
                part, layers = passes.forward(rows, keep)
                parts.append(part)
                if keep and len(bands) == 1:
                    kept = layers
        ctx.save_for_backward(*inputs)
        ctx.context, ctx.bands, ctx.kept = (projected, spans, rules), bands, kept
        images = tuple(_to_images(torch.cat(x), projected, spans) for x in zip(*parts, strict=True))
        ctx.mark_non_differentiable(images[2])
        return images

    @staticmethod
    def backward(ctx: Any, grad_sums: Tensor, grad_transmittance: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError(
                "composite: expected backward without create_graph, the renderer has no second derivative"
            )
        projected, spans, rules = ctx.context
        passes, columns = _Passes(ctx.saved_tensors, projected, spans, rules), spans.grid[1]
        _, factors, opacities, _ = passes.inputs
        grads = _to_tiles(grad_sums, spans)
        behind = _to_tiles(grad_transmittance, spans)
        moments, width = any(ctx.needs_input_grad[:3]), grads.shape[1] if ctx.needs_input_grad[3] else 0
        total = factors.new_zeros(spans.ids.shape[0], 6 * moments + width)
        with full_precision(factors.device):
            for begin, end in ctx.bands:
                layers, ctx.kept = ctx.kept, None  # its memory is free after this; a second backward makes it again
                if layers is None:
                    layers = passes.forward((begin, end), keep=True)[1]
                tiles = slice(begin * columns, end * columns)
                passes.backward(layers, grads[tiles], behind[tiles], total, moments=moments, features=width > 0)
        ids = spans.ids
        found: tuple[Tensor | None, ...] = (None, None, None, total[:, total.shape[1] - width :])
        if moments:
            used = factors.index_select(0, ids), opacities.index_select(0, ids)
            found = (*_from_moments(total[:, :6], *used, projected.eps2d), found[3])

        def of_all(value: Tensor) -> Tensor:
            return value.new_zeros(factors.shape[0], *value.shape[1:]).index_copy_(0, ids, value)

        wanted = zip(found, ctx.needs_input_grad, strict=False)
        return *(of_all(x) if needed and x is not None else None for x, needed in wanted), *[None] * 5


def _table(means2d: Tensor, factors: Tensor, opacities: Tensor, eps2d: float) -> Tensor:
    """What a step needs of each Gaussian, `(10, M)`: see `Band`."""
    ax, ay, bx, by = whitening(*variances(factors, eps2d))
    x, y = means2d.unbind(1)
    return torch.stack(
        [
            opacities.log(),
            x,
            y,
            -0.5 * (ax * ax + bx * bx),
            -(ax * ay + bx * by),
            -0.5 * (ay * ay + by * by),
            ax,
            ay,
            bx,
            by,
        ]
    )


def _from_moments(rows: Tensor, factors: Tensor, opacities: Tensor, eps2d: float) -> tuple[Tensor, Tensor, Tensor]:
    """From moments s of dL/d ln alpha, `(n, 6)`, to gradients of means2d, factors and opacities.

    With the conic Q: dL/d mean = Q s_1 and, for Sigma' = M M^T + e I, dL/dM = Q S_2 (Q M).
    """
    s0, sx, sy, sxx, sxy, syy = columns(rows)
    xx, xy, yy, det = variances(factors, eps2d)

    def conic(x: Tensor, y: Tensor) -> Tensor:
        return torch.stack([yy * x - xy * y, xx * y - xy * x]).div_(det)

    x, y = _whitened(factors, eps2d, det)
    d_factors = conic(sxx * x + sxy * y, sxy * x + syy * y)
    return conic(sx, sy).t(), d_factors.permute(2, 0, 1), s0 / opacities


def _whitened(factors: Tensor, eps2d: float, det: Tensor) -> Tensor:
    """Q M, `(2, 3, n)`, without the cancellation of a product: a needle's long axis is nearly in the kernel of Q.

    With the rows a, b of M and w = a x b the rows of det Q M are e a + b x w and e b + w x a.
    """
    rows = columns(factors).unflatten(0, (2, 3))
    a, b = rows
    w = torch.linalg.cross(a, b, dim=0)
    turned = torch.stack([torch.linalg.cross(b, w, dim=0), torch.linalg.cross(w, a, dim=0)])
    return turned.add_(rows, alpha=eps2d).div_(det)


def _to_images(tiles: Tensor, projected: ProjectedGaussians, spans: TileSpans) -> Tensor:
    """`(C * rows * columns, F, P)` to `(C, F, H, W)`."""
    size, (rows, columns) = spans.tile_size, spans.grid
    height, width = projected.image_size
    images = tiles.view(projected.num_cameras, rows, columns, -1, size, size).permute(0, 3, 1, 4, 2, 5)
    return images.reshape(projected.num_cameras, -1, rows * size, columns * size)[:, :, :height, :width].clone()


def _to_tiles(images: Tensor, spans: TileSpans) -> Tensor:
    """The inverse of `_to_images`; pixels beyond the image are 0."""
    size, (rows, columns) = spans.tile_size, spans.grid
    cameras, channels, height, width = images.shape
    images = F.pad(images, (0, columns * size - width, 0, rows * size - height))
    tiles = images.view(cameras, channels, rows, size, columns, size).permute(0, 2, 4, 1, 3, 5)
    return tiles.reshape(cameras * rows * columns, channels, size * size)


def check_options(tile_size: int, alpha_threshold: float, transmittance_stop: float, chunk_size: int | None) -> None:
    """Raise a ValueError for an option of `composite` that is out of range."""
    if not isinstance(tile_size, int) or tile_size < 1:
        raise ValueError(f"tile_size: expected an integer >= 1, got {tile_size}")
    if chunk_size is not None and chunk_size < 1:
        raise ValueError(f"chunk_size: expected at least 1 or None, got {chunk_size}")
    for name, value in (("alpha_threshold", alpha_threshold), ("transmittance_stop", transmittance_stop)):
        if not 0.0 <= value < 1.0:
            raise ValueError(f"{name}: expected a number in [0, 1), got {value}")
