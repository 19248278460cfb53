"""Kernels that find which Gaussian reaches which tile; the spans are those of `kgs.backends.torch.binning`.

A lane is a Gaussian, in depth order. `count_entries` and `fill_entries` go through the same rows of tiles and columns,
so that each Gaussian writes its entries where the sum of the counts before it says. `count_all_entries` counts before
it is known how many Gaussians there are.
"""

import triton
import triton.language as tl

from .compositing_kernels import SIZE
from .footprint_kernels import load_factors, variances

_S: tl.constexpr = tl.constexpr(SIZE)
_ROOT: tl.constexpr = tl.constexpr(0.8493218002880191)  # sqrt(log2(e) / 2): exp(-q / 2) = 2^-(ROOT^2 q)
_TWICE_LN2: tl.constexpr = tl.constexpr(1.3862943611198906)
_WIDER: tl.constexpr = tl.constexpr(1e-3)  # see `kgs.geometry.projection.cut_squared`


@triton.jit(do_not_specialize=["n"])
def fill_table(
    order, means2d, factors, opacities, depths, eps2d, n, table, counts, sorted_counts, begins,
    HAS_COUNTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """What compositing reads of each Gaussian; see `.compositing_kernels`.

    With `HAS_COUNTS` also their `counts` in depth order, and the 0 with which `begins` begins.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    g = tl.load(order + i, mask=inside, other=0)
    opacity = tl.load(opacities + g, mask=inside, other=0.0)
    a0, a1, a2, b0, b1, b2 = load_factors(factors, g, inside)
    xx, xy, yy, det = variances(a0, a1, a2, b0, b1, b2, eps2d)
    # LDL^T with the larger variance as pivot: the exponent keeps its accuracy for needles
    pivot = tl.maximum(xx, yy)
    slope = -xy / pivot
    opaque = opacity == float("inf")  # everywhere
    along = tl.where(opaque, 0.0, 1.0 / tl.sqrt(pivot) * _ROOT)
    across = tl.where(opaque, 0.0, tl.sqrt(pivot / det) * _ROOT)
    wide = xx >= yy
    row = table + i * 8
    tl.store(row, tl.minimum(tl.log2(opacity), 128.0), mask=inside)  # 2^128 is infinite already
    tl.store(row + 1, tl.load(means2d + g * 2, mask=inside, other=0.0), mask=inside)
    tl.store(row + 2, tl.load(means2d + g * 2 + 1, mask=inside, other=0.0), mask=inside)
    tl.store(row + 3, tl.where(wide, slope * across, across), mask=inside)
    tl.store(row + 4, tl.where(wide, across, slope * across), mask=inside)
    tl.store(row + 5, tl.where(wide, along, 0.0), mask=inside)
    tl.store(row + 6, tl.where(wide, 0.0, along), mask=inside)
    tl.store(row + 7, tl.load(depths + g, mask=inside, other=0.0), mask=inside)
    if HAS_COUNTS:
        tl.store(sorted_counts + i, tl.load(counts + g, mask=inside, other=0), mask=inside)
        tl.store(begins + i, i.to(tl.int64), mask=i == 0)


@triton.jit
def _reach(means2d, factors, opacities, g, inside, eps2d, log2_threshold, height, first_row, last_row):
    """The rows of tiles of one image, from `first_row` to `last_row`, that each Gaussian reaches, and its ellipse."""
    x = tl.load(means2d + g * 2, mask=inside, other=0.0)
    y = tl.load(means2d + g * 2 + 1, mask=inside, other=0.0)
    opacity = tl.load(opacities + g, mask=inside, other=0.0)
    a0, a1, a2, b0, b1, b2 = load_factors(factors, g, inside)
    xx, xy, yy, det = variances(a0, a1, a2, b0, b1, b2, eps2d)
    cut = (tl.log2(opacity) - log2_threshold) * _TWICE_LN2 + _WIDER  # infinite for a threshold of 0
    half = tl.sqrt(tl.maximum(cut, 0.0) * yy)
    top, bottom = tl.ceil(y - half), tl.floor(y + half)
    # nothing that is not a number passes
    reaches = (
        inside & (cut > 0.0) & (xx + yy < float("inf")) & (bottom >= top) & (bottom >= 0.0) & (top <= height - 1.0)
    )
    top = tl.where(reaches, tl.maximum(top, 0.0), 0.0)
    bottom = tl.where(reaches, tl.minimum(bottom, height - 1.0), 0.0)
    row = tl.maximum(top.to(tl.int32) // _S, first_row)
    end = tl.where(reaches, tl.minimum(bottom.to(tl.int32) // _S + 1, last_row), row)
    return row, end, x, y, half, cut, xy / yy, det / yy, 1.0 / yy, xy * tl.sqrt(cut / xx)


@triton.jit
def _span(row, active, x, y, half, cut, slope, across, inverse, rightmost, width):
    """The first column that an ellipse touches in a row of tiles, and how many."""
    low = (row * _S).to(tl.float32) - y
    high = tl.minimum(low + (_S - 1), half)
    low = tl.maximum(low, -half)
    dy = tl.minimum(tl.maximum(-rightmost, low), high)
    left = tl.ceil(x + slope * dy - tl.sqrt(tl.maximum(cut - dy * dy * inverse, 0.0) * across))
    dy = tl.minimum(tl.maximum(rightmost, low), high)
    right = tl.floor(x + slope * dy + tl.sqrt(tl.maximum(cut - dy * dy * inverse, 0.0) * across))
    everywhere = cut == float("inf")
    left = tl.where(everywhere, 0.0, left)
    right = tl.where(everywhere, width - 1.0, right)
    reaches = active & (right >= left) & (right >= 0.0) & (left <= width - 1.0)  # nothing that is not a number passes
    first = tl.where(reaches, tl.maximum(left, 0.0), 0.0).to(tl.int32) // _S
    last = tl.where(reaches, tl.minimum(right, width - 1.0), 0.0).to(tl.int32) // _S
    return first, tl.where(reaches, last - first + 1, 0)


@triton.jit
def _count(
    means2d, factors, opacities, g, inside, eps2d, log2_threshold, height, width, first_row, last_row,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """How many tiles each Gaussian reaches in some rows of tiles of one image."""
    row, stop, x, y, half, cut, slope, across, inverse, rightmost = _reach(
        means2d, factors, opacities, g, inside, eps2d, log2_threshold, height, first_row, last_row
    )
    total = tl.zeros((BLOCK,), tl.int32)
    left = tl.max(stop - row, 0)
    while left > 0:
        _, count = _span(row, row < stop, x, y, half, cut, slope, across, inverse, rightmost, width)
        total += count
        row += 1
        left -= 1
    return total


@triton.jit(do_not_specialize=["height", "width", "image_rows"])
def count_all_entries(
    numbers, means2d, factors, opacities, eps2d, log2_threshold, height, width, image_rows, counts, sums,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """How many tiles each of the first `numbers[0]` Gaussians reaches, all of one camera, and each block of them."""
    b = tl.program_id(0)
    i = b * BLOCK + tl.arange(0, BLOCK)
    inside = i < tl.load(numbers)
    total = _count(
        means2d, factors, opacities, i.to(tl.int64), inside, eps2d, log2_threshold, height, width, 0, image_rows, BLOCK
    )
    tl.store(counts + i, total, mask=inside)
    tl.store(sums + b, tl.sum(total.to(tl.int64), 0))


@triton.jit(do_not_specialize=["blocks"])
def sum_counts(sums, blocks, out, BLOCK: tl.constexpr):
    """The sum of all blocks; one program."""
    i = tl.arange(0, BLOCK)
    total = tl.zeros((BLOCK,), tl.int64)
    first = 0
    while first < blocks:
        total += tl.load(sums + first + i, mask=first + i < blocks, other=0)
        first += BLOCK
    tl.store(out, tl.sum(total, 0))


@triton.jit(do_not_specialize=["height", "width", "image_rows", "begin", "end", "n"])
def count_entries(
    order, means2d, factors, opacities, camera_ids, eps2d, log2_threshold, height, width, image_rows, begin, end, n,
    counts, begins,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """How many tiles each Gaussian reaches in the rows of tiles `begin` to `end`, numbered through all cameras.

    And the 0 with which `begins` begins.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    g = tl.load(order + i, mask=inside, other=0)
    top = tl.load(camera_ids + g, mask=inside, other=0).to(tl.int32) * image_rows
    first_row, last_row = tl.maximum(begin - top, 0), tl.minimum(end - top, image_rows)
    total = _count(
        means2d, factors, opacities, g, inside, eps2d, log2_threshold, height, width, first_row, last_row, BLOCK
    )
    tl.store(counts + i, total, mask=inside)
    tl.store(begins + i, i.to(tl.int64), mask=i == 0)


@triton.jit(do_not_specialize=["height", "width", "image_rows", "begin", "end", "n", "columns"])
def fill_entries(
    order, means2d, factors, opacities, camera_ids, eps2d, log2_threshold, height, width, image_rows, begin, end, n,
    columns, begins, tiles, ranks,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """The tiles that each Gaussian reaches, from `begins[i]` on, and beside them its rank in depth order.

    As many as were counted: a compiler may round one of the two kernels otherwise, at the edge of a tile. What is
    missing lies behind all tiles.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < n
    g = tl.load(order + i, mask=inside, other=0)
    top = tl.load(camera_ids + g, mask=inside, other=0).to(tl.int32) * image_rows
    first_row, last_row = tl.maximum(begin - top, 0), tl.minimum(end - top, image_rows)
    row, stop, x, y, half, cut, slope, across, inverse, rightmost = _reach(
        means2d, factors, opacities, g, inside, eps2d, log2_threshold, height, first_row, last_row
    )
    at = tl.load(begins + i, mask=inside, other=0)
    full = tl.load(begins + i + 1, mask=inside, other=0)
    left = tl.max(stop - row, 0)
    while left > 0:
        first, count = _span(row, row < stop, x, y, half, cut, slope, across, inverse, rightmost, width)
        tile = (top + row - begin) * columns + first
        maximum = tl.max(count, 0)
        c = 0
        while c < maximum:
            fits = (c < count) & (at + c < full)
            tl.store(tiles + at + c, tile + c, mask=fits)
            tl.store(ranks + at + c, i, mask=fits)
            c += 1
        at += count
        row += 1
        left -= 1
    missing = tl.max(full - at, 0)
    while missing > 0:
        tl.store(tiles + at, at.to(tl.int32) * 0 + (end - begin) * columns, mask=at < full)
        at += 1
        missing -= 1


@triton.jit(do_not_specialize=["entries", "tiles", "steps"])
def list_tiles(keys, slots, ranks, entries, tiles, steps, listed, offsets, BLOCK: tl.constexpr):
    """The ranks in the order of the sorted tiles `keys`, and where each tile begins, found in `steps` halvings."""
    first = tl.program_id(0).to(tl.int64) * BLOCK
    i = first + tl.arange(0, BLOCK)
    inside = i < entries
    slot = tl.load(slots + i, mask=inside, other=0)
    tl.store(listed + i, tl.load(ranks + slot, mask=inside, other=0), mask=inside)
    low, high = i * 0, i * 0 + entries
    left = tl.where(first <= tiles, steps, 0)
    while left > 0:
        middle = low + (high - low) // 2
        searched = low < high
        before = tl.load(keys + middle, mask=searched, other=0).to(tl.int64) < i
        low = tl.where(searched & before, middle + 1, low)
        high = tl.where(searched & (before == 0), middle, high)
        left -= 1
    tl.store(offsets + i, low, mask=i <= tiles)
