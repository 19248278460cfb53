"""Projection by pinhole cameras with the colours of harmonics, and its gradient: one Gaussian at a time.

The formulas are those of `projection`, `lenses` and `covariance` in `kgs.geometry`; gradients of cameras are in
:mod:`.camera_kernels`. A camera is a tuple: world to camera `(3, 4)`, intrinsics `(2, 3)`, limits of x / z and y / z
`(2, 2)`, inverse of the pose's 3x3 block, centre `(3,)`.
"""

import math

import numpy as np

from kgs._support.compiled.kernel import HALF, LARGEST, ONE, TWO, ZERO, f32, inline, is_finite, jit, scratch
from kgs._support.compiled.lanes import (
    WIDTH,
    load,
    magnitude,
    maximum,
    minimum,
    root,
    store,
    where_above,
    where_at_least,
)

from .harmonics_kernels import BAND_0, THREE, basis_gradient, evaluate_harmonics, harmonics_basis

SMALLEST_SQUARE, LARGEST_SQUARE = f32(1e-30), f32(1e36)
BLOCK = 2048  # Gaussians that are listed in one go; rows of the lists of a block begin where its Gaussians do
_SMALL, _UP = f32(1e-18), f32(2.0**96)
_LARGE, _DOWN = f32(1e18), f32(2.0**-96)
PART = 64  # Gaussians whose numbers are turned into columns in one go


@inline
def empty_columns(count):
    """Columns of zeros."""
    columns = scratch(count * PART)
    for i in range(count * PART):
        columns[i] = ZERO
    return columns


@inline
def read(values, g, count, columns, first, i):
    """Put `count` numbers of row g into slot i of columns, `(columns PART,)`."""
    for j in range(count):
        columns[(first + j) * PART + i] = values[g, j]


@inline
def column(columns, j, p):
    """Lanes of column j."""
    return load(columns, j * PART + p)


@inline
def write(columns, j, p, value):
    """Fill lanes of column j."""
    store(columns, j * PART + p, value)


@inline
def rotation(w, x, y, z):
    """Unit quaternion, 1 / norm, rotation matrix by rows; the zero quaternion turns nothing and gets no gradient."""
    largest = maximum(maximum(magnitude(w), magnitude(x)), maximum(magnitude(y), magnitude(z)))
    scale = where_above(_SMALL, largest, _UP, where_above(largest, _LARGE, _DOWN, ONE))  # no square over- or underflows
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    square = w * w + x * x + y * y + z * z
    inverse = where_above(square, ZERO, ONE / root(square), ZERO)
    w = where_above(square, ZERO, w * inverse, ONE)
    x, y, z = x * inverse, y * inverse, z * inverse
    xx, yy, zz = TWO * x * x, TWO * y * y, TWO * z * z
    xy, xz, yz, wx, wy, wz = TWO * x * y, TWO * x * z, TWO * y * z, TWO * w * x, TWO * w * y, TWO * w * z
    r = (ONE - yy - zz, xy - wz, xz + wy, xy + wz, ONE - xx - zz, yz - wx, xz - wy, yz + wx, ONE - xx - yy)
    return (w, x, y, z), inverse * scale, r


@inline
def camera_point(x, y, z, v):
    """The centre in camera axes."""
    return (
        v[0, 0] * x + v[0, 1] * y + v[0, 2] * z + v[0, 3],
        v[1, 0] * x + v[1, 1] * y + v[1, 2] * z + v[1, 3],
        v[2, 0] * x + v[2, 1] * y + v[2, 2] * z + v[2, 3],
    )


@inline
def rows(x, y, inverse, v, k, limits):
    """J and J W, each by rows, and the clamped tangents."""
    tx = minimum(maximum(x * inverse, limits[0, 0]), limits[0, 1])
    ty = minimum(maximum(y * inverse, limits[1, 0]), limits[1, 1])
    j = (
        k[0, 0] * inverse,
        k[0, 1] * inverse,
        ZERO - (k[0, 0] * tx + k[0, 1] * ty) * inverse,
        k[1, 0] * inverse,
        k[1, 1] * inverse,
        ZERO - (k[1, 0] * tx + k[1, 1] * ty) * inverse,
    )
    a = (
        j[0] * v[0, 0] + j[1] * v[1, 0] + j[2] * v[2, 0],
        j[0] * v[0, 1] + j[1] * v[1, 1] + j[2] * v[2, 1],
        j[0] * v[0, 2] + j[1] * v[1, 2] + j[2] * v[2, 2],
        j[3] * v[0, 0] + j[4] * v[1, 0] + j[5] * v[2, 0],
        j[3] * v[0, 1] + j[4] * v[1, 1] + j[5] * v[2, 1],
        j[3] * v[0, 2] + j[4] * v[1, 2] + j[5] * v[2, 2],
    )
    return j, a, tx, ty


@inline
def _turned(a, r):
    """J W R by rows."""
    return (
        a[0] * r[0] + a[1] * r[3] + a[2] * r[6],
        a[0] * r[1] + a[1] * r[4] + a[2] * r[7],
        a[0] * r[2] + a[1] * r[5] + a[2] * r[8],
        a[3] * r[0] + a[4] * r[3] + a[5] * r[6],
        a[3] * r[1] + a[4] * r[4] + a[5] * r[7],
        a[3] * r[2] + a[4] * r[5] + a[5] * r[8],
    )


@inline
def turned_back(t, r):
    """The product with the transposed rotation, by rows: from dL/d(J W R) to dL/d(J W)."""
    return (
        t[0] * r[0] + t[1] * r[1] + t[2] * r[2],
        t[0] * r[3] + t[1] * r[4] + t[2] * r[5],
        t[0] * r[6] + t[1] * r[7] + t[2] * r[8],
        t[3] * r[0] + t[4] * r[1] + t[5] * r[2],
        t[3] * r[3] + t[4] * r[4] + t[5] * r[5],
        t[3] * r[6] + t[4] * r[7] + t[5] * r[8],
    )


@inline
def _direction(means, g, centre):
    """Unit vector from the camera's centre, and 1 / distance."""
    x, y, z = means[g, 0] - centre[0], means[g, 1] - centre[1], means[g, 2] - centre[2]
    square = x * x + y * y + z * z
    scale = ONE
    if not SMALLEST_SQUARE <= square <= LARGEST_SQUARE:  # beyond 1e18, or nearer than 1e-15: the squares are not right
        scale = ONE / max(abs(x), abs(y), abs(z))
        x, y, z = x * scale, y * scale, z * scale
        square = x * x + y * y + z * z
    inverse = ONE / math.sqrt(square)
    return x * inverse, y * inverse, z * inverse, inverse * scale


@inline
def _is_finite(g, means, quats, scales, opacities, colors):
    total = quats[g, 3]
    for i in range(3):
        total += means[g, i] + quats[g, i] + scales[g, i]
    for i in range(opacities.shape[0]):
        total += opacities[i, g]
    for i in range(colors.shape[1]):
        total += colors[g, i]
    finite = True
    if not is_finite(total):  # a finite sum has finite terms
        finite = is_finite(quats[g, 3])
        for i in range(3):
            finite &= is_finite(means[g, i]) and is_finite(quats[g, i]) and is_finite(scales[g, i])
        for i in range(opacities.shape[0]):
            finite &= is_finite(opacities[i, g])
        for i in range(colors.shape[1]):
            finite &= is_finite(colors[g, i])
    return finite


@jit
def footprints(begin, end, means, quats, scales, opacities, colors, c, camera, frustum, lists, counts):
    """List which Gaussians camera c sees, of the blocks from `begin` to `end`.

    Opacities are `(1, N)` or a row per camera, colours `(N, F)`; `frustum` is height, width, near plane, eps2d, and how
    many standard deviations wide a footprint counts as visible. Written are the `lists`, means2d, factors `(N, 6)`,
    depths, opacities, colours of harmonics `(N, 3)` (`(N, 0)` where none are wanted), radii and numbers of the
    Gaussians, and in `counts` how many of each block are visible and how many are not finite, `(blocks, 2)`.
    """
    bands = colors.shape[1] // 3 if lists[4].shape[1] else 0
    b = np.empty(16, np.float32)
    columns = empty_columns(_READ)
    row = min(c, opacities.shape[0] - 1)
    for block in range(begin, end):
        m, broken = block * BLOCK, 0
        block_end = min((block + 1) * BLOCK, len(means))
        for part in range(block * BLOCK, block_end, PART):
            n = min(PART, block_end - part)
            for i in range(n):
                g = part + i
                read(means, g, 3, columns, 0, i)
                read(quats, g, 4, columns, 3, i)
                read(scales, g, 3, columns, 7, i)
                others = ZERO
                for j in range(opacities.shape[0]):
                    others += opacities[j, g]
                for j in range(colors.shape[1]):
                    others += colors[g, j]
                columns[10 * PART + i] = others
            for p in range(0, n, WIDTH):
                _footprint(p, camera, frustum, columns)
            for i in range(n):
                g = part + i
                if columns[11 * PART + i] == ZERO and not _is_finite(g, means, quats, scales, opacities, colors):
                    broken += 1
                    continue
                if columns[12 * PART + i] == ZERO:
                    continue
                _list(m, g, i, columns, opacities[row, g], lists)
                if bands == 1:
                    for j in range(3):
                        color = BAND_0 * colors[g, j]
                        lists[4][m, j] = ZERO if color < -HALF else color + HALF
                elif bands:
                    dx, dy, dz, _ = _direction(means, g, camera[4])
                    harmonics_basis(dx, dy, dz, bands, b)
                    red, green, blue = evaluate_harmonics(colors, g, bands, b)
                    rgb = lists[4]
                    rgb[m, 0] = ZERO if red < ZERO else red
                    rgb[m, 1] = ZERO if green < ZERO else green
                    rgb[m, 2] = ZERO if blue < ZERO else blue
                m += 1
        counts[block, 0], counts[block, 1] = m - block * BLOCK, broken


_READ = 23  # columns of `footprints`: see `_footprint`


@inline
def _footprint(p, camera, frustum, columns):
    """From columns 0 to 10, mean, quaternion, scales, the sum of other numbers, to 11 to 22 of some Gaussians.

    These are 1 where all numbers are finite (0 also where only their sum is not), 1 where it is visible; the centre in
    pixels, the six factors, the depth, the squared radius of one standard deviation.
    """
    v, k, limits, _, _ = camera
    height, width, near, eps2d, cutoff = frustum
    x0, y0, z0 = column(columns, 0, p), column(columns, 1, p), column(columns, 2, p)
    qw, qx, qy, qz = column(columns, 3, p), column(columns, 4, p), column(columns, 5, p), column(columns, 6, p)
    s0, s1, s2 = column(columns, 7, p), column(columns, 8, p), column(columns, 9, p)
    total = x0 + y0 + z0 + qw + qx + qy + qz + s0 + s1 + s2 + column(columns, 10, p)
    finite = where_at_least(LARGEST, magnitude(total), ONE, ZERO)  # a finite sum has finite terms
    x, y, z = camera_point(x0, y0, z0, v)
    inverse = ONE / z
    _, a, _, _ = rows(x, y, inverse, v, k, limits)
    _, _, r = rotation(qw, qx, qy, qz)
    f = _turned(a, r)
    a0, a1, a2, b0, b1, b2 = f[0] * s0, f[1] * s1, f[2] * s2, f[3] * s0, f[4] * s1, f[5] * s2
    px, py = (k[0, 0] * x + k[0, 1] * y) * inverse + k[0, 2], (k[1, 0] * x + k[1, 1] * y) * inverse + k[1, 2]
    xx, xy, yy = a0 * a0 + a1 * a1 + a2 * a2, a0 * b0 + a1 * b1 + a2 * b2, b0 * b0 + b1 * b1 + b2 * b2
    c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    det = c0 * c0 + c1 * c1 + c2 * c2 + eps2d * (xx + yy) + eps2d * eps2d
    xx, yy = xx + eps2d, yy + eps2d
    largest = HALF * (xx + yy) + _hypotenuse(HALF * (xx - yy), xy)
    rx, ry = cutoff * root(xx), cutoff * root(yy)
    seen = where_above(z, near, ONE, ZERO)
    seen = where_above(det, ZERO, seen, ZERO)
    seen = where_at_least(LARGEST, magnitude(det + largest + px + py), seen, ZERO)
    seen = where_above(px + rx, ZERO - HALF, seen, ZERO)
    seen = where_above(width - HALF, px - rx, seen, ZERO)
    seen = where_above(py + ry, ZERO - HALF, seen, ZERO)
    seen = where_above(height - HALF, py - ry, seen, ZERO)
    write(columns, 11, p, finite)
    write(columns, 12, p, seen)
    write(columns, 13, p, px)
    write(columns, 14, p, py)
    write(columns, 15, p, a0)
    write(columns, 16, p, a1)
    write(columns, 17, p, a2)
    write(columns, 18, p, b0)
    write(columns, 19, p, b1)
    write(columns, 20, p, b2)
    write(columns, 21, p, z)
    write(columns, 22, p, largest)


@inline
def _hypotenuse(x, y):
    """The root of the sum of squares, which may overflow."""
    largest = maximum(magnitude(x), magnitude(y))
    inverse = ONE / maximum(largest, SMALLEST_SQUARE)
    x, y = x * inverse, y * inverse
    return largest * root(x * x + y * y)


@inline
def _list(m, g, i, columns, opacity, lists):
    """Write what `_footprint` has computed of Gaussian g to row m of the lists."""
    means2d, factors, depths, alphas, _, radii, ids = lists
    means2d[m, 0] = columns[13 * PART + i]
    means2d[m, 1] = columns[14 * PART + i]
    for j in range(6):
        factors[m, j] = columns[(15 + j) * PART + i]
    depths[m] = columns[21 * PART + i]
    alphas[m] = opacity
    radii[m] = np.ceil(THREE * math.sqrt(columns[22 * PART + i]))
    ids[m] = g


@inline
def color_gradients(g, means, colors, centre, bands, gradient, b, h, d_colors):
    """Add to the gradients of harmonics of more than one band; returns the colour's part of the centre's gradient."""
    x, y, z, inverse = _direction(means, g, centre)
    harmonics_basis(x, y, z, bands, b)
    red, green, blue = evaluate_harmonics(colors, g, bands, b)
    red = ZERO if red < ZERO else gradient[0]
    green = ZERO if green < ZERO else gradient[1]
    blue = ZERO if blue < ZERO else gradient[2]
    if d_colors.shape[1]:
        for k in range(bands):
            d_colors[g, 3 * k] += b[k] * red
            d_colors[g, 3 * k + 1] += b[k] * green
            d_colors[g, 3 * k + 2] += b[k] * blue
    for k in range(bands):
        h[k] = red * colors[g, 3 * k] + green * colors[g, 3 * k + 1] + blue * colors[g, 3 * k + 2]
    gx, gy, gz = basis_gradient(x, y, z, bands, h)
    along = gx * x + gy * y + gz * z
    return (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse


@inline
def _quaternion_gradient(q, inverse, a, h):
    """From dL/d(J W R) to the quaternion, along the unit sphere."""
    w, x, y, z = q
    r00, r01, r02 = a[0] * h[0] + a[3] * h[3], a[0] * h[1] + a[3] * h[4], a[0] * h[2] + a[3] * h[5]
    r10, r11, r12 = a[1] * h[0] + a[4] * h[3], a[1] * h[1] + a[4] * h[4], a[1] * h[2] + a[4] * h[5]
    r20, r21, r22 = a[2] * h[0] + a[5] * h[3], a[2] * h[1] + a[5] * h[4], a[2] * h[2] + a[5] * h[5]
    px, py, pz, sxy, sxz, syz = r21 - r12, r02 - r20, r10 - r01, r01 + r10, r02 + r20, r12 + r21
    dw = TWO * (x * px + y * py + z * pz)
    dx = TWO * (w * px - TWO * x * (r11 + r22) + y * sxy + z * sxz)
    dy = TWO * (w * py - TWO * y * (r00 + r22) + x * sxy + z * syz)
    dz = TWO * (w * pz - TWO * z * (r00 + r11) + x * sxz + y * syz)
    along = w * dw + x * dx + y * dy + z * dz
    return (
        (dw - along * w) * inverse,
        (dx - along * x) * inverse,
        (dy - along * y) * inverse,
        (dz - along * z) * inverse,
    )


@inline
def point_gradient(x, y, z, v, k, limits, u, g_mean, g_depth):
    """From dL/d(J W), the pixel and the depth to the centre in camera axes, and to J by rows."""
    inverse = ONE / z
    j, _, tx, ty = rows(x, y, inverse, v, k, limits)
    j00, j01 = u[0] * v[0, 0] + u[1] * v[0, 1] + u[2] * v[0, 2], u[0] * v[1, 0] + u[1] * v[1, 1] + u[2] * v[1, 2]
    j10, j11 = u[3] * v[0, 0] + u[4] * v[0, 1] + u[5] * v[0, 2], u[3] * v[1, 0] + u[4] * v[1, 1] + u[5] * v[1, 2]
    j02, j12 = u[0] * v[2, 0] + u[1] * v[2, 1] + u[2] * v[2, 2], u[3] * v[2, 0] + u[4] * v[2, 1] + u[5] * v[2, 2]
    px, py = (
        (k[0, 0] * g_mean[0] + k[1, 0] * g_mean[1]) * inverse,
        (k[0, 1] * g_mean[0] + k[1, 1] * g_mean[1]) * inverse,
    )
    gz = g_depth - (px * x + py * y) * inverse
    gz = gz - (j00 * j[0] + j01 * j[1] + j02 * j[2] + j10 * j[3] + j11 * j[4] + j12 * j[5]) * inverse
    across = within(x * inverse, limits[0, 0], limits[0, 1], (k[0, 0] * j02 + k[1, 0] * j12) * inverse * inverse)
    up = within(y * inverse, limits[1, 0], limits[1, 1], (k[0, 1] * j02 + k[1, 1] * j12) * inverse * inverse)
    return px - across, py - up, gz + across * tx + up * ty, (j00, j01, j02, j10, j11, j12)


@inline
def within(x, low, high, value):
    """The value where x is in the range, else 0."""
    return where_at_least(x, low, where_at_least(high, x, value, ZERO), ZERO)


@jit
def footprint_gradients(begin, end, means, quats, scales, colors, c, camera, ids, gradients, outs):
    """From gradients of what camera c sees to those of a range of Gaussians; the first camera also fills with zeros.

    `ids` are the Gaussians that it sees, ascending, `(M,)`; `gradients` those of means2d, factors `(M, 6)`, depths,
    opacities and colours `(M, 3)` or `(M, 0)`. Added to are `outs`, of means, quats, scales, opacities `(1, N)` or
    `(C, N)`, and colours `(N, F)`, or `(N, 0)` where that is not wanted.
    """
    g_means2d, g_factors, g_depths, g_opacities, g_rgb = gradients
    d_means, d_quats, d_scales, d_opacities, d_colors = outs
    bands = colors.shape[1] // 3 if g_rgb.shape[1] else 0
    b, h = np.empty(16, np.float32), np.empty(16, np.float32)
    row = min(c, d_opacities.shape[0] - 1)
    if c == 0:
        for g in range(begin, end):
            for i in range(3):
                d_means[g, i] = d_scales[g, i] = ZERO
            for i in range(4):
                d_quats[g, i] = ZERO
            for i in range(d_opacities.shape[0]):
                d_opacities[i, g] = ZERO
            for i in range(d_colors.shape[1]):
                d_colors[g, i] = ZERO
    columns = empty_columns(_COLUMNS)
    last = np.searchsorted(ids, end)
    for first in range(np.searchsorted(ids, begin), last, PART):
        n = min(PART, last - first)
        for i in range(n):
            m, g = first + i, ids[first + i]
            read(means, g, 3, columns, 0, i)
            read(quats, g, 4, columns, 3, i)
            read(scales, g, 3, columns, 7, i)
            read(g_factors, m, 6, columns, 10, i)
            read(g_means2d, m, 2, columns, 16, i)
            columns[18 * PART + i] = g_depths[m]
        for p in range(0, n, WIDTH):
            _gradient(p, camera, columns)
        for i in range(n):
            m, g = first + i, ids[first + i]
            d_opacities[row, g] += g_opacities[m]
            for j in range(3):
                d_means[g, j] += columns[j * PART + i]
                d_scales[g, j] += columns[(7 + j) * PART + i]
            for j in range(4):
                d_quats[g, j] += columns[(3 + j) * PART + i]
            if bands == 1:
                if d_colors.shape[1]:
                    for j in range(3):
                        d_colors[g, j] += ZERO if BAND_0 * colors[g, j] < -HALF else BAND_0 * g_rgb[m, j]
            elif bands:
                gradient = g_rgb[m, 0], g_rgb[m, 1], g_rgb[m, 2]
                wx, wy, wz = color_gradients(g, means, colors, camera[4], bands, gradient, b, h, d_colors)
                d_means[g, 0] += wx
                d_means[g, 1] += wy
                d_means[g, 2] += wz


_COLUMNS = 19  # of `footprint_gradients`: see `_gradient`


@inline
def _gradient(p, camera, columns):
    """In columns 0 to 9, mean, quaternion, scales, put their gradients.

    Columns 10 to 18 are the gradients of factors, the centre in pixels, and the depth.
    """
    v, k, limits, _, _ = camera
    x0, y0, z0 = column(columns, 0, p), column(columns, 1, p), column(columns, 2, p)
    qw, qx, qy, qz = column(columns, 3, p), column(columns, 4, p), column(columns, 5, p), column(columns, 6, p)
    s0, s1, s2 = column(columns, 7, p), column(columns, 8, p), column(columns, 9, p)
    t0, t1, t2 = column(columns, 10, p), column(columns, 11, p), column(columns, 12, p)
    t3, t4, t5 = column(columns, 13, p), column(columns, 14, p), column(columns, 15, p)
    x, y, z = camera_point(x0, y0, z0, v)
    _, a, _, _ = rows(x, y, ONE / z, v, k, limits)
    q, inverse, r = rotation(qw, qx, qy, qz)
    f = _turned(a, r)
    write(columns, 7, p, t0 * f[0] + t3 * f[3])
    write(columns, 8, p, t1 * f[1] + t4 * f[4])
    write(columns, 9, p, t2 * f[2] + t5 * f[5])
    t = (t0 * s0, t1 * s1, t2 * s2, t3 * s0, t4 * s1, t5 * s2)
    dw, dx, dy, dz = _quaternion_gradient(q, inverse, a, t)
    write(columns, 3, p, dw)
    write(columns, 4, p, dx)
    write(columns, 5, p, dy)
    write(columns, 6, p, dz)
    g_mean = (column(columns, 16, p), column(columns, 17, p))
    gx, gy, gz, _ = point_gradient(x, y, z, v, k, limits, turned_back(t, r), g_mean, column(columns, 18, p))
    write(columns, 0, p, v[0, 0] * gx + v[1, 0] * gy + v[2, 0] * gz)
    write(columns, 1, p, v[0, 1] * gx + v[1, 1] * gy + v[2, 1] * gz)
    write(columns, 2, p, v[0, 2] * gx + v[1, 2] * gy + v[2, 2] * gz)
