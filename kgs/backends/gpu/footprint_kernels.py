"""What kernels of several stages share; formulas as in `kgs.geometry.covariance`."""

import triton
import triton.language as tl

LARGEST: tl.constexpr = tl.constexpr(3.4028234663852886e38)


@triton.jit
def is_finite(x):
    """Neither infinite nor not a number."""
    return tl.abs(x) <= LARGEST


@triton.jit
def load_factors(factors, g, mask):
    """The rows a, b of M, six numbers."""
    f = factors + g * 6
    return (
        tl.load(f, mask=mask, other=0.0),
        tl.load(f + 1, mask=mask, other=0.0),
        tl.load(f + 2, mask=mask, other=0.0),
        tl.load(f + 3, mask=mask, other=0.0),
        tl.load(f + 4, mask=mask, other=0.0),
        tl.load(f + 5, mask=mask, other=0.0),
    )


@triton.jit
def variances(a0, a1, a2, b0, b1, b2, eps2d):
    """Entries xx, xy, yy and determinant of M M^T + e I for the rows a, b of M."""
    xx = a0 * a0 + a1 * a1 + a2 * a2
    xy = a0 * b0 + a1 * b1 + a2 * b2
    yy = b0 * b0 + b1 * b1 + b2 * b2
    u, v, w = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    det = u * u + v * v + w * w + eps2d * (xx + yy) + eps2d * eps2d
    return xx + eps2d, xy, yy + eps2d, det


@triton.jit
def load_four(address, mask):
    """Four neighbouring numbers for each lane: one access where all addresses are multiples of 16 bytes."""
    numbers = tl.load(address[:, None] + tl.arange(0, 4)[None, :], mask=mask[:, None], other=0.0)
    even, odd = tl.split(tl.reshape(numbers, (address.shape[0], 2, 2)))
    first, third = tl.split(even)
    second, fourth = tl.split(odd)
    return first, second, third, fourth


@triton.jit
def put_four(address, first, second, third, fourth, mask, ADD: tl.constexpr):
    """Store four neighbouring numbers for each lane, or add them to what is there."""
    numbers = tl.join(tl.join(first, third), tl.join(second, fourth))
    numbers = tl.reshape(numbers, (address.shape[0], 4))
    put(address[:, None] + tl.arange(0, 4)[None, :], numbers, mask[:, None], ADD)


@triton.jit
def put(address, value, mask, ADD: tl.constexpr):
    """Store a value, or add it to what is there."""
    if ADD:
        value += tl.load(address, mask=mask, other=0.0)
    tl.store(address, value, mask=mask)
