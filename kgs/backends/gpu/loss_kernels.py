"""L1 + w (1 - SSIM) and its gradient, by the formulas of `kgs.losses.photometric`, a pixel for each lane.

The window is separable, and so is its adjoint with the reflected border folded back: each of four kernels goes over all
pixels once, along rows or columns, and reads 11 neighbours. Arrays, K the channels of all pictures, H, W >= 11:

    image, target, mean_y, variance_y   (K, H, W), the latter two local moments of the target
    across                              (3, K, H, W), of x, x^2 and x y the sums along rows
    maps                                (3, K, H, W), derivatives of the SSIM by local mean, square and product
    sums                                (2, blocks), of the absolute difference and of the SSIM
    down                                (3, K, H, W), of the maps the adjoint along columns

`pixels`, K H W, is added twice: from 2^30 on 2 `pixels` would not fit into its 32 bits.
"""

import triton
import triton.language as tl

RADIUS: tl.constexpr = tl.constexpr(5)
C1: tl.constexpr = tl.constexpr(0.01**2)
C2: tl.constexpr = tl.constexpr(0.03**2)
EPS: tl.constexpr = tl.constexpr(1e-12)


@triton.jit
def _tap(t0, t1, t2, t3, t4, t5, j: tl.constexpr):
    """Weight j, from 0 to 10, of the symmetric window."""
    if j == 0 or j == 10:
        return t0
    elif j == 1 or j == 9:
        return t1
    elif j == 2 or j == 8:
        return t2
    elif j == 3 or j == 7:
        return t3
    elif j == 4 or j == 6:
        return t4
    else:
        return t5


@triton.jit
def _mirror(i, length):
    """The pixel that the reflected border shows at i, from -5 to length + 4."""
    i = tl.abs(i)
    return tl.where(i < length, i, 2 * (length - 1) - i)


@triton.jit
def _folded(maps, base, i, stride, length, mask, t0, t1, t2, t3, t4, t5):
    """The adjoint of the window along one axis, with what the border mirrored: at index i of lines of some length."""
    total = (i * 0).to(tl.float32)
    for j in tl.static_range(11):
        weight = _tap(t0, t1, t2, t3, t4, t5, j)
        o = i + RADIUS - j
        total += weight * tl.load(maps + base + o * stride, mask=mask & (o >= 0) & (o < length), other=0.0)
        o = RADIUS - j - i
        near = mask & (i > 0) & (o >= 0)
        total += weight * tl.load(maps + base + o * stride, mask=near, other=0.0)
        o = 2 * (length - 1) - i + RADIUS - j
        far = mask & (i < length - 1) & (o >= 0) & (o < length)
        total += weight * tl.load(maps + base + o * stride, mask=far, other=0.0)
    return total


@triton.jit(do_not_specialize=["pixels", "width"])
def sum_across(image, target, pixels, width, t0, t1, t2, t3, t4, t5, across, BLOCK: tl.constexpr):
    """The window along rows, of x, x^2 and x y."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < pixels
    column = i % width
    line = i - column
    mean = tl.zeros((BLOCK,), tl.float32)
    square = mean
    product = mean
    for j in tl.static_range(11):
        weight = _tap(t0, t1, t2, t3, t4, t5, j)
        at = line + _mirror(column + j - RADIUS, width)
        x = tl.load(image + at, mask=inside, other=0.0)
        y = tl.load(target + at, mask=inside, other=0.0)
        mean += weight * x
        square += weight * (x * x)
        product += weight * (x * y)
    tl.store(across + i, mean, mask=inside)
    tl.store(across + pixels + i, square, mask=inside)
    tl.store(across + pixels + pixels + i, product, mask=inside)


@triton.jit(do_not_specialize=["pixels", "height", "width", "blocks"])
def ssim_maps(
    image, target, mean_y, variance_y, pixels, height, width, t0, t1, t2, t3, t4, t5, across, maps, sums, blocks,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Derivatives of the SSIM; sums of both terms of the loss over each block."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < pixels
    column = i % width
    row = i // width % height
    top = i - row * width - column
    mean = tl.zeros((BLOCK,), tl.float32)
    square = mean
    product = mean
    for j in tl.static_range(11):
        weight = _tap(t0, t1, t2, t3, t4, t5, j)
        at = across + top + _mirror(row + j - RADIUS, height) * width + column
        mean += weight * tl.load(at, mask=inside, other=0.0)
        square += weight * tl.load(at + pixels, mask=inside, other=0.0)
        product += weight * tl.load(at + pixels + pixels, mask=inside, other=0.0)
    my = tl.load(mean_y + i, mask=inside, other=0.0)
    b = 2.0 * (product - mean * my) + C2
    d = square - mean * mean + tl.load(variance_y + i, mask=inside, other=0.0) + C2
    a = 2.0 * (mean * my) + C1
    e = mean * mean + my * my + C1
    inverse = 1.0 / (e * d + EPS)
    ssim = a * b * inverse
    scaled = ssim * inverse
    by_square = -e * scaled
    tl.store(maps + i, 2.0 * ((b - a) * inverse * my - (d * scaled + by_square) * mean), mask=inside)
    tl.store(maps + pixels + i, by_square, mask=inside)
    tl.store(maps + pixels + pixels + i, 2.0 * a * inverse, mask=inside)
    x = tl.load(image + i, mask=inside, other=0.0)
    y = tl.load(target + i, mask=inside, other=0.0)
    tl.store(sums + tl.program_id(0), tl.sum(tl.abs(x - y), 0))
    tl.store(sums + blocks + tl.program_id(0), tl.sum(tl.where(inside, ssim, 0.0), 0))


@triton.jit(do_not_specialize=["blocks", "pixels"])
def add_up(sums, blocks, pixels, dssim_weight, loss, WIDE: tl.constexpr, BLOCK: tl.constexpr):
    """The loss from the sums over blocks, in float64 with `WIDE`. One program."""
    kind: tl.constexpr = tl.float64 if WIDE else tl.float32
    i = tl.arange(0, BLOCK)
    absolute = tl.zeros((BLOCK,), kind)
    ssim = absolute
    first = 0
    while first < blocks:
        inside = first + i < blocks
        absolute += tl.load(sums + first + i, mask=inside, other=0.0).to(kind)
        ssim += tl.load(sums + blocks + first + i, mask=inside, other=0.0).to(kind)
        first += BLOCK
    mean = tl.sum(ssim, 0) / pixels
    mean = tl.where(mean > 1.0, 1.0, mean)  # what is not a number stays
    tl.store(loss, (tl.sum(absolute, 0) / pixels + dssim_weight * (1.0 - mean)).to(tl.float32))


@triton.jit(do_not_specialize=["pixels", "height", "width"])
def fold_down(maps, pixels, height, width, t0, t1, t2, t3, t4, t5, down, BLOCK: tl.constexpr):
    """The adjoint of the window along columns, of one of the maps."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < pixels
    row = i // width % height
    first = tl.program_id(1).to(tl.int64) * pixels
    total = _folded(maps, first + i - row * width, row, width, height, inside, t0, t1, t2, t3, t4, t5)
    tl.store(down + first + i, total, mask=inside)


@triton.jit(do_not_specialize=["pixels", "width"])
def gradient_across(
    image, target, pixels, width, t0, t1, t2, t3, t4, t5, down, by_ssim, by_l1, by_loss, grad, BLOCK: tl.constexpr
):  # fmt: skip
    """The adjoint along rows, times what the maps multiply, and the gradient of the absolute difference.

    Both are scaled, by numbers and by the gradient of the loss, which is read.
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < pixels
    column = i % width
    line = i - column
    x = tl.load(image + i, mask=inside, other=0.0)
    y = tl.load(target + i, mask=inside, other=0.0)
    total = _folded(down, line, column, 1, width, inside, t0, t1, t2, t3, t4, t5)
    total += 2.0 * x * _folded(down, pixels + line, column, 1, width, inside, t0, t1, t2, t3, t4, t5)
    total += y * _folded(down, pixels + line + pixels, column, 1, width, inside, t0, t1, t2, t3, t4, t5)
    sign = tl.where(x > y, 1.0, 0.0) - tl.where(x < y, 1.0, 0.0)
    tl.store(grad + i, (by_ssim * total + by_l1 * sign) * tl.load(by_loss), mask=inside)
