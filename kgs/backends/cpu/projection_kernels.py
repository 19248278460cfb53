"""Projection by pinhole cameras with the colours of harmonics, and its gradient: one Gaussian at a time.

The formulas are those of `kgs.projection`, `kgs.camera` and `kgs.covariance`; gradients of cameras are in
:mod:`.camera_kernels`. A camera is a tuple: world to camera `(3, 4)`, intrinsics `(2, 3)`, limits of x / z and y / z
`(2, 2)`, inverse of the pose's 3x3 block, centre `(3,)`.
"""

import math

import numpy as np

from kgs.compiled.kernel import HALF, ONE, TWO, ZERO, f32, inline, is_finite, jit

from .harmonics_kernels import THREE, basis_gradient, evaluate_harmonics, harmonics_basis

SMALLEST_SQUARE, LARGEST_SQUARE = f32(1e-30), f32(1e36)
BLOCK = 2048  # Gaussians that are listed in one go; rows of the lists of a block begin where its Gaussians do


@inline
def rotation(quats, g):
    """Unit quaternion, 1 / norm, rotation matrix by rows; the zero quaternion turns nothing and gets no gradient."""
    qw, qx, qy, qz = np.float64(quats[g, 0]), np.float64(quats[g, 1]), np.float64(quats[g, 2]), np.float64(quats[g, 3])
    norm = math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)  # in float64 no square overflows or vanishes
    inverse = 1.0 / norm if norm > 0.0 else 0.0
    w = f32(qw * inverse) if norm > 0.0 else ONE
    x, y, z = f32(qx * inverse), f32(qy * inverse), f32(qz * inverse)
    xx, yy, zz = TWO * x * x, TWO * y * y, TWO * z * z
    xy, xz, yz, wx, wy, wz = TWO * x * y, TWO * x * z, TWO * y * z, TWO * w * x, TWO * w * y, TWO * w * z
    r = (ONE - yy - zz, xy - wz, xz + wy, xy + wz, ONE - xx - zz, yz - wx, xz - wy, yz + wx, ONE - xx - yy)
    return (w, x, y, z), f32(inverse), r


@inline
def camera_point(means, g, v):
    """The centre in camera axes."""
    x, y, z = means[g, 0], means[g, 1], means[g, 2]
    return (
        v[0, 0] * x + v[0, 1] * y + v[0, 2] * z + v[0, 3],
        v[1, 0] * x + v[1, 1] * y + v[1, 2] * z + v[1, 3],
        v[2, 0] * x + v[2, 1] * y + v[2, 2] * z + v[2, 3],
    )


@inline
def rows(x, y, inverse, v, k, limits):
    """J and J W, each by rows, and the clamped tangents."""
    tx, ty = x * inverse, y * inverse
    tx = limits[0, 0] if tx < limits[0, 0] else limits[0, 1] if tx > limits[0, 1] else tx
    ty = limits[1, 0] if ty < limits[1, 0] else limits[1, 1] if ty > limits[1, 1] else ty
    j = (
        k[0, 0] * inverse,
        k[0, 1] * inverse,
        -(k[0, 0] * tx + k[0, 1] * ty) * inverse,
        k[1, 0] * inverse,
        k[1, 1] * inverse,
        -(k[1, 0] * tx + k[1, 1] * ty) * inverse,
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
    v, k, limits, _, centre = camera
    height, width, near, eps2d, cutoff = frustum
    means2d, factors, depths, alphas, rgb, radii, ids = lists
    bands = colors.shape[1] // 3 if rgb.shape[1] else 0
    b = np.empty(16, np.float32)
    row = min(c, opacities.shape[0] - 1)
    for block in range(begin, end):
        m, broken = block * BLOCK, 0
        for g in range(block * BLOCK, min((block + 1) * BLOCK, len(means))):
            if not _is_finite(g, means, quats, scales, opacities, colors):
                broken += 1
                continue
            x, y, z = camera_point(means, g, v)
            if not z > near:
                continue
            inverse = ONE / z
            _, a, _, _ = rows(x, y, inverse, v, k, limits)
            f = _turned(a, rotation(quats, g)[2])
            s0, s1, s2 = scales[g, 0], scales[g, 1], scales[g, 2]
            a0, a1, a2, b0, b1, b2 = f[0] * s0, f[1] * s1, f[2] * s2, f[3] * s0, f[4] * s1, f[5] * s2
            px, py = (k[0, 0] * x + k[0, 1] * y) * inverse + k[0, 2], (k[1, 0] * x + k[1, 1] * y) * inverse + k[1, 2]
            xx, xy, yy = a0 * a0 + a1 * a1 + a2 * a2, a0 * b0 + a1 * b1 + a2 * b2, b0 * b0 + b1 * b1 + b2 * b2
            c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
            det = c0 * c0 + c1 * c1 + c2 * c2 + eps2d * (xx + yy) + eps2d * eps2d
            xx, yy = xx + eps2d, yy + eps2d
            difference, across = np.float64(HALF * (xx - yy)), np.float64(xy)
            largest = HALF * (xx + yy) + f32(math.sqrt(difference * difference + across * across))
            if not (det > ZERO and is_finite(det + largest + px + py)):
                continue
            rx, ry = cutoff * math.sqrt(xx), cutoff * math.sqrt(yy)
            if px + rx > -HALF and px - rx < width - HALF and py + ry > -HALF and py - ry < height - HALF:
                ids[m], depths[m], alphas[m], radii[m] = g, z, opacities[row, g], np.ceil(THREE * math.sqrt(largest))
                means2d[m, 0], means2d[m, 1] = px, py
                factors[m, 0], factors[m, 1], factors[m, 2] = a0, a1, a2
                factors[m, 3], factors[m, 4], factors[m, 5] = b0, b1, b2
                if bands:
                    dx, dy, dz, _ = _direction(means, g, centre)
                    harmonics_basis(dx, dy, dz, bands, b)
                    red, green, blue = evaluate_harmonics(colors, g, bands, b)
                    rgb[m, 0] = ZERO if red < ZERO else red
                    rgb[m, 1] = ZERO if green < ZERO else green
                    rgb[m, 2] = ZERO if blue < ZERO else blue
                m += 1
        counts[block, 0], counts[block, 1] = m - block * BLOCK, broken


@inline
def color_gradients(g, means, colors, centre, bands, gradient, b, h, d_colors):
    """Add to the harmonics' gradients; returns the colour's contribution to the gradient of the centre."""
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
    gx = gy = gz = ZERO
    if bands > 1:
        for k in range(bands):
            h[k] = red * colors[g, 3 * k] + green * colors[g, 3 * k + 1] + blue * colors[g, 3 * k + 2]
        gx, gy, gz = basis_gradient(x, y, z, bands, h)
        along = gx * x + gy * y + gz * z
        gx, gy, gz = (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse
    return gx, gy, gz


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
    gx, gy, gz = px, py, g_depth - (px * x + py * y) * inverse
    gz -= (j00 * j[0] + j01 * j[1] + j02 * j[2] + j10 * j[3] + j11 * j[4] + j12 * j[5]) * inverse
    if limits[0, 0] <= x * inverse <= limits[0, 1]:
        t = -(k[0, 0] * j02 + k[1, 0] * j12) * inverse * inverse
        gx, gz = gx + t, gz - t * tx
    if limits[1, 0] <= y * inverse <= limits[1, 1]:
        t = -(k[0, 1] * j02 + k[1, 1] * j12) * inverse * inverse
        gy, gz = gy + t, gz - t * ty
    return gx, gy, gz, (j00, j01, j02, j10, j11, j12)


@jit
def footprint_gradients(begin, end, means, quats, scales, colors, c, camera, ids, gradients, outs):
    """From gradients of what camera c sees to those of a range of Gaussians; the first camera also fills with zeros.

    `ids` are the Gaussians that it sees, ascending, `(M,)`; `gradients` those of means2d, factors `(M, 6)`, depths,
    opacities and colours `(M, 3)` or `(M, 0)`. Added to are `outs`, of means, quats, scales, opacities `(1, N)` or
    `(C, N)`, and colours `(N, F)`, or `(N, 0)` where that is not wanted.
    """
    v, k, limits, _, centre = camera
    g_means2d, g_factors, g_depths, g_opacities, g_rgb = gradients
    d_means, d_quats, d_scales, d_opacities, d_colors = outs
    bands = colors.shape[1] // 3 if g_rgb.shape[1] else 0
    b, h = np.empty(16, np.float32), np.empty(16, np.float32)
    row = min(c, d_opacities.shape[0] - 1)
    m = np.searchsorted(ids, begin)
    for g in range(begin, end):
        if c == 0:
            for i in range(3):
                d_means[g, i] = d_quats[g, i] = d_scales[g, i] = ZERO
            d_quats[g, 3] = ZERO
            for i in range(d_opacities.shape[0]):
                d_opacities[i, g] = ZERO
            for i in range(d_colors.shape[1]):
                d_colors[g, i] = ZERO
        if m == len(ids) or ids[m] != g:
            continue
        d_opacities[row, g] += g_opacities[m]
        x, y, z = camera_point(means, g, v)
        _, a, _, _ = rows(x, y, ONE / z, v, k, limits)
        q, inverse, r = rotation(quats, g)
        s, f = (scales[g, 0], scales[g, 1], scales[g, 2]), _turned(a, r)
        t = (g_factors[m, 0], g_factors[m, 1], g_factors[m, 2], g_factors[m, 3], g_factors[m, 4], g_factors[m, 5])
        d_scales[g, 0] += t[0] * f[0] + t[3] * f[3]
        d_scales[g, 1] += t[1] * f[1] + t[4] * f[4]
        d_scales[g, 2] += t[2] * f[2] + t[5] * f[5]
        t = (t[0] * s[0], t[1] * s[1], t[2] * s[2], t[3] * s[0], t[4] * s[1], t[5] * s[2])
        dw, dx, dy, dz = _quaternion_gradient(q, inverse, a, t)
        d_quats[g, 0], d_quats[g, 1] = d_quats[g, 0] + dw, d_quats[g, 1] + dx
        d_quats[g, 2], d_quats[g, 3] = d_quats[g, 2] + dy, d_quats[g, 3] + dz
        u = turned_back(t, r)
        x, y, z, _ = point_gradient(x, y, z, v, k, limits, u, (g_means2d[m, 0], g_means2d[m, 1]), g_depths[m])
        gx, gy = v[0, 0] * x + v[1, 0] * y + v[2, 0] * z, v[0, 1] * x + v[1, 1] * y + v[2, 1] * z
        gz = v[0, 2] * x + v[1, 2] * y + v[2, 2] * z
        if bands:
            gradient = g_rgb[m, 0], g_rgb[m, 1], g_rgb[m, 2]
            wx, wy, wz = color_gradients(g, means, colors, centre, bands, gradient, b, h, d_colors)
            gx, gy, gz = gx + wx, gy + wy, gz + wz
        d_means[g, 0], d_means[g, 1], d_means[g, 2] = d_means[g, 0] + gx, d_means[g, 1] + gy, d_means[g, 2] + gz
        m += 1
