"""Spherical harmonics up to degree 3 at one direction: basis, colour, derivative; as in `kgs.geometry.harmonics`."""

from kgs._support.compiled.kernel import HALF, TWO, ZERO, f32, inline

THREE, FOUR, SIX, EIGHT = f32(3.0), f32(4.0), f32(6.0), f32(8.0)
BAND_0, _B = f32(0.28209479177387814), f32(0.4886025119029199)
_C0, _C2, _C4 = f32(1.0925484305920792), f32(0.31539156525252005), f32(0.5462742152960396)
_D0, _D1, _D2 = f32(0.5900435899266435), f32(2.890611442640554), f32(0.4570457994644658)
_D3, _D5 = f32(0.3731763325901154), f32(1.445305721320277)


@inline
def harmonics_basis(x, y, z, bands, b):
    """The first `bands` basis functions (0, 1, 4, 9 or 16) at a unit vector, into b."""
    b[0] = BAND_0
    if bands > 1:
        b[1], b[2], b[3] = -_B * y, _B * z, -_B * x
    if bands > 4:
        xx, yy, zz = x * x, y * y, z * z
        b[4], b[5], b[6] = _C0 * x * y, -_C0 * y * z, _C2 * (TWO * zz - xx - yy)
        b[7], b[8] = -_C0 * x * z, _C4 * (xx - yy)
        if bands > 9:
            b[9], b[10], b[11] = -_D0 * y * (THREE * xx - yy), _D1 * x * y * z, -_D2 * y * (FOUR * zz - xx - yy)
            b[12], b[13] = _D3 * z * (TWO * zz - THREE * xx - THREE * yy), -_D2 * x * (FOUR * zz - xx - yy)
            b[14], b[15] = _D5 * z * (xx - yy), -_D0 * x * (xx - THREE * yy)


@inline
def evaluate_harmonics(colors, g, bands, b):
    """1/2 + sum_k b_k c_k of row g of `(N, 3 bands)`, three numbers: colours before they are clamped."""
    red = green = blue = ZERO
    for k in range(bands):
        red += b[k] * colors[g, 3 * k]
        green += b[k] * colors[g, 3 * k + 1]
        blue += b[k] * colors[g, 3 * k + 2]
    return red + HALF, green + HALF, blue + HALF


@inline
def basis_gradient(x, y, z, bands, h):
    """sum_k h_k grad b_k by the direction, for more than one band."""
    gx, gy, gz = -_B * h[3], -_B * h[1], _B * h[2]
    if bands > 4:
        gx += _C0 * (y * h[4] - z * h[7]) - TWO * _C2 * x * h[6] + TWO * _C4 * x * h[8]
        gy += _C0 * (x * h[4] - z * h[5]) - TWO * _C2 * y * h[6] - TWO * _C4 * y * h[8]
        gz += -_C0 * (y * h[5] + x * h[7]) + FOUR * _C2 * z * h[6]
    if bands > 9:
        xx, yy, zz, xy = x * x, y * y, z * z, x * y
        gx += -SIX * _D0 * xy * h[9] + _D1 * y * z * h[10] + TWO * _D2 * xy * h[11] - SIX * _D3 * x * z * h[12]
        gx += -_D2 * (FOUR * zz - THREE * xx - yy) * h[13] + TWO * _D5 * x * z * h[14] - THREE * _D0 * (xx - yy) * h[15]
        gy += -THREE * _D0 * (xx - yy) * h[9] + _D1 * x * z * h[10] - _D2 * (FOUR * zz - xx - THREE * yy) * h[11]
        gy += -SIX * _D3 * y * z * h[12] + TWO * _D2 * xy * h[13] - TWO * _D5 * y * z * h[14] + SIX * _D0 * xy * h[15]
        gz += _D1 * xy * h[10] - EIGHT * _D2 * z * (y * h[11] + x * h[13])
        gz += _D3 * (SIX * zz - THREE * xx - THREE * yy) * h[12] + _D5 * (xx - yy) * h[14]
    return gx, gy, gz
