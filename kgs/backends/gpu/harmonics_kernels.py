"""Spherical harmonics up to degree 3, a direction a lane: colour and derivative, as in `kgs.geometry.harmonics`."""

import triton
import triton.language as tl

from .footprint_kernels import load_four

_A: tl.constexpr = tl.constexpr(0.28209479177387814)
_B: tl.constexpr = tl.constexpr(0.4886025119029199)
_C0: tl.constexpr = tl.constexpr(1.0925484305920792)
_C2: tl.constexpr = tl.constexpr(0.31539156525252005)
_C4: tl.constexpr = tl.constexpr(0.5462742152960396)
_D0: tl.constexpr = tl.constexpr(0.5900435899266435)
_D1: tl.constexpr = tl.constexpr(2.890611442640554)
_D2: tl.constexpr = tl.constexpr(0.4570457994644658)
_D3: tl.constexpr = tl.constexpr(0.3731763325901154)
_D5: tl.constexpr = tl.constexpr(1.445305721320277)


@triton.jit
def basis(x, y, z, k: tl.constexpr):
    """Basis function k, from 0 to 15, at a unit vector."""
    if k == 0:
        return x * 0.0 + _A
    elif k == 1:
        return y * -_B
    elif k == 2:
        return z * _B
    elif k == 3:
        return x * -_B
    elif k == 4:
        return x * y * _C0
    elif k == 5:
        return y * z * -_C0
    elif k == 6:
        return (2.0 * z * z - x * x - y * y) * _C2
    elif k == 7:
        return x * z * -_C0
    elif k == 8:
        return (x * x - y * y) * _C4
    elif k == 9:
        return y * (3.0 * x * x - y * y) * -_D0
    elif k == 10:
        return x * y * z * _D1
    elif k == 11:
        return y * (4.0 * z * z - x * x - y * y) * -_D2
    elif k == 12:
        return z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y) * _D3
    elif k == 13:
        return x * (4.0 * z * z - x * x - y * y) * -_D2
    elif k == 14:
        return z * (x * x - y * y) * _D5
    else:
        return x * (x * x - 3.0 * y * y) * -_D0


@triton.jit
def basis_gradient(x, y, z, h, k: tl.constexpr):
    """H times the gradient of basis function k, from 1 to 15, by the direction; three numbers."""
    zero = x * 0.0
    if k == 1:
        return zero, h * -_B, zero
    elif k == 2:
        return zero, zero, h * _B
    elif k == 3:
        return h * -_B, zero, zero
    elif k == 4:
        return h * y * _C0, h * x * _C0, zero
    elif k == 5:
        return zero, h * z * -_C0, h * y * -_C0
    elif k == 6:
        return h * x * (-2.0 * _C2), h * y * (-2.0 * _C2), h * z * (4.0 * _C2)
    elif k == 7:
        return h * z * -_C0, zero, h * x * -_C0
    elif k == 8:
        return h * x * (2.0 * _C4), h * y * (-2.0 * _C4), zero
    elif k == 9:
        return h * x * y * (-6.0 * _D0), h * (x * x - y * y) * (-3.0 * _D0), zero
    elif k == 10:
        return h * y * z * _D1, h * x * z * _D1, h * x * y * _D1
    elif k == 11:
        return h * x * y * (2.0 * _D2), h * (4.0 * z * z - x * x - 3.0 * y * y) * -_D2, h * y * z * (-8.0 * _D2)
    elif k == 12:
        slope = 6.0 * z * z - 3.0 * x * x - 3.0 * y * y
        return h * x * z * (-6.0 * _D3), h * y * z * (-6.0 * _D3), h * slope * _D3
    elif k == 13:
        return h * (4.0 * z * z - 3.0 * x * x - y * y) * -_D2, h * x * y * (2.0 * _D2), h * x * z * (-8.0 * _D2)
    elif k == 14:
        return h * x * z * (2.0 * _D5), h * y * z * (-2.0 * _D5), h * (x * x - y * y) * _D5
    else:
        return h * (x * x - y * y) * (-3.0 * _D0), h * x * y * (6.0 * _D0), zero


@triton.jit
def load_bands(row, inside):
    """The colours of four bands: red, green and blue of the first, and so on."""
    r0, g0, b0, r1 = load_four(row, inside)
    g1, b1, r2, g2 = load_four(row + 4, inside)
    b2, r3, g3, b3 = load_four(row + 8, inside)
    return r0, g0, b0, r1, g1, b1, r2, g2, b2, r3, g3, b3


@triton.jit
def evaluate(colors, g, inside, x, y, z, BANDS: tl.constexpr):
    """1/2 + sum_k b_k c_k of rows g of `(N, BANDS, 3)`: colours before they are clamped."""
    row = colors + g.to(tl.int64) * (3 * BANDS)
    red = x * 0.0 + 0.5
    green = red
    blue = red
    for k in tl.static_range(0, BANDS // 4 * 4, 4):
        r0, g0, b0, r1, g1, b1, r2, g2, b2, r3, g3, b3 = load_bands(row + 3 * k, inside)
        b = basis(x, y, z, k)
        red, green, blue = red + b * r0, green + b * g0, blue + b * b0
        b = basis(x, y, z, k + 1)
        red, green, blue = red + b * r1, green + b * g1, blue + b * b1
        b = basis(x, y, z, k + 2)
        red, green, blue = red + b * r2, green + b * g2, blue + b * b2
        b = basis(x, y, z, k + 3)
        red, green, blue = red + b * r3, green + b * g3, blue + b * b3
    for k in tl.static_range(BANDS // 4 * 4, BANDS):
        b = basis(x, y, z, k)
        red += b * tl.load(row + 3 * k, mask=inside, other=0.0)
        green += b * tl.load(row + 3 * k + 1, mask=inside, other=0.0)
        blue += b * tl.load(row + 3 * k + 2, mask=inside, other=0.0)
    return red, green, blue
