"""Projection by pinhole cameras with the colours of harmonics, and its gradient: a Gaussian for each lane.

The formulas are those of `projection`, `lenses` and `covariance` in `kgs.geometry`; a camera is a row of numbers, see
:mod:`.camera_kernels`. Arrays of N Gaussians, C cameras and B blocks of Gaussians:

    opacities  (1, N) or (C, N)
    flags      (C + 1, N)    whether a pair is visible; in the last row, whether all of a Gaussian's numbers are finite
    counts     (C + 1, B)    how many flags of a block are set; then, of a camera, how many pairs are visible before it
    numbers    (C + 3,)      how many pairs are visible up to and including each camera, how many Gaussians are not
                             finite, whether the kernels cover all cameras; of one camera, how many entries there are

The visible pairs are numbered camera by camera, in the order of the Gaussians: their rows.
"""

import triton
import triton.language as tl

from .camera_kernels import COVERED, CUTOFF, WIDTH
from .footprint_kernels import is_finite, load_factors, load_four, put, put_four, variances
from .harmonics_kernels import basis, basis_gradient, evaluate, load_bands

_WIDTH: tl.constexpr = tl.constexpr(WIDTH)
_COVERED: tl.constexpr = tl.constexpr(COVERED)
_CUTOFF: tl.constexpr = tl.constexpr(CUTOFF)


@triton.jit(do_not_specialize=["n", "views", "features", "cameras", "blocks"])
def check_gaussians(
    means, quats, scales, opacities, colors, n, views, features, cameras, blocks, flags, counts, largest,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Whether each Gaussian is finite; and of each block the largest opacity of those that are, and their number."""
    b = tl.program_id(0)
    g = b * BLOCK + tl.arange(0, BLOCK)
    inside = g < n
    all_finite = inside
    for i in tl.static_range(3):
        all_finite &= is_finite(tl.load(means + g * 3 + i, mask=inside, other=0.0))
        all_finite &= is_finite(tl.load(scales + g * 3 + i, mask=inside, other=0.0))
    for i in tl.static_range(4):
        all_finite &= is_finite(tl.load(quats + g * 4 + i, mask=inside, other=0.0))
    maximum = tl.zeros((BLOCK,), tl.float32)
    view = 0
    while view < views:
        opacity = tl.load(opacities + view * n + g, mask=inside, other=0.0)
        all_finite &= is_finite(opacity)
        maximum = tl.maximum(maximum, opacity)
        view += 1
    f = tl.arange(0, 16)
    row = colors + g.to(tl.int64)[:, None] * features + f[None, :]
    first = 0
    while first < features:
        value = tl.load(row + first, mask=inside[:, None] & (f + first < features)[None, :], other=0.0)
        all_finite &= tl.min(is_finite(value).to(tl.int32), 1) > 0
        first += 16
    tl.store(flags + (g * 0 + cameras).to(tl.int64) * n + g, all_finite.to(tl.int8), mask=inside)
    tl.store(counts + cameras * blocks + b, tl.sum(all_finite.to(tl.int64), 0))
    tl.store(largest + b, tl.max(tl.where(all_finite, maximum, 0.0), 0))


@triton.jit
def _camera_point(camera, means, g, inside):
    """The centre in the world, and in camera axes."""
    mx = tl.load(means + g * 3, mask=inside, other=0.0)
    my = tl.load(means + g * 3 + 1, mask=inside, other=0.0)
    mz = tl.load(means + g * 3 + 2, mask=inside, other=0.0)
    x = tl.load(camera) * mx + tl.load(camera + 1) * my + tl.load(camera + 2) * mz + tl.load(camera + 3)
    y = tl.load(camera + 4) * mx + tl.load(camera + 5) * my + tl.load(camera + 6) * mz + tl.load(camera + 7)
    z = tl.load(camera + 8) * mx + tl.load(camera + 9) * my + tl.load(camera + 10) * mz + tl.load(camera + 11)
    return mx, my, mz, x, y, z


@triton.jit
def _jacobian(camera, x, y, inverse):
    """J by rows, and the clamped tangents."""
    tx = tl.minimum(tl.maximum(x * inverse, tl.load(camera + 18)), tl.load(camera + 19))
    ty = tl.minimum(tl.maximum(y * inverse, tl.load(camera + 20)), tl.load(camera + 21))
    k00, k01, k10, k11 = tl.load(camera + 12), tl.load(camera + 13), tl.load(camera + 15), tl.load(camera + 16)
    j02, j12 = -(k00 * tx + k01 * ty) * inverse, -(k10 * tx + k11 * ty) * inverse
    return k00 * inverse, k01 * inverse, j02, k10 * inverse, k11 * inverse, j12, tx, ty


@triton.jit
def _to_world(camera, x, y, z):
    """A vector of camera axes in those of the world: a row of J becomes one of J W."""
    return (
        x * tl.load(camera) + y * tl.load(camera + 4) + z * tl.load(camera + 8),
        x * tl.load(camera + 1) + y * tl.load(camera + 5) + z * tl.load(camera + 9),
        x * tl.load(camera + 2) + y * tl.load(camera + 6) + z * tl.load(camera + 10),
    )


@triton.jit
def _to_camera(camera, x, y, z):
    """A vector of the world in camera axes."""
    return (
        x * tl.load(camera) + y * tl.load(camera + 1) + z * tl.load(camera + 2),
        x * tl.load(camera + 4) + y * tl.load(camera + 5) + z * tl.load(camera + 6),
        x * tl.load(camera + 8) + y * tl.load(camera + 9) + z * tl.load(camera + 10),
    )


@triton.jit
def _rotation(quats, g, inside):
    """Unit quaternion, 1 / norm, rotation matrix by rows; the zero quaternion turns nothing and gets no gradient."""
    w, x, y, z = load_four(quats + g * 4, inside)
    peak = tl.maximum(tl.maximum(tl.abs(w), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(z)))
    turns = peak > 0.0
    scale = tl.where(turns, peak, 1.0)  # no square overflows or vanishes
    w, x, y, z = w / scale, x / scale, y / scale, z / scale
    norm = tl.where(turns, tl.sqrt(w * w + x * x + y * y + z * z), 1.0)
    w, x, y, z = tl.where(turns, w / norm, 1.0), x / norm, y / norm, z / norm
    inverse = tl.where(turns, 1.0 / norm / scale, 0.0)
    xx, yy, zz = 2.0 * x * x, 2.0 * y * y, 2.0 * z * z
    xy, xz, yz = 2.0 * x * y, 2.0 * x * z, 2.0 * y * z
    wx, wy, wz = 2.0 * w * x, 2.0 * w * y, 2.0 * w * z
    r00, r01, r02 = 1.0 - yy - zz, xy - wz, xz + wy
    r10, r11, r12 = xy + wz, 1.0 - xx - zz, yz - wx
    r20, r21, r22 = xz - wy, yz + wx, 1.0 - xx - yy
    return w, x, y, z, inverse, r00, r01, r02, r10, r11, r12, r20, r21, r22


@triton.jit
def _turned(a0, a1, a2, b0, b1, b2, r00, r01, r02, r10, r11, r12, r20, r21, r22):
    """The product with a rotation of two rows."""
    return (
        a0 * r00 + a1 * r10 + a2 * r20,
        a0 * r01 + a1 * r11 + a2 * r21,
        a0 * r02 + a1 * r12 + a2 * r22,
        b0 * r00 + b1 * r10 + b2 * r20,
        b0 * r01 + b1 * r11 + b2 * r21,
        b0 * r02 + b1 * r12 + b2 * r22,
    )


@triton.jit
def _footprint(camera, means, quats, scales, g, inside, near):
    """Whether a Gaussian lies beyond the near plane, its depth, pixel and factors."""
    _, _, _, x, y, z = _camera_point(camera, means, g, inside)
    beyond = z > near
    inverse = 1.0 / tl.where(beyond, z, 1.0)
    j00, j01, j02, j10, j11, j12, _, _ = _jacobian(camera, x, y, inverse)
    a0, a1, a2 = _to_world(camera, j00, j01, j02)
    b0, b1, b2 = _to_world(camera, j10, j11, j12)
    _, _, _, _, _, r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(quats, g, inside)
    a0, a1, a2, b0, b1, b2 = _turned(a0, a1, a2, b0, b1, b2, r00, r01, r02, r10, r11, r12, r20, r21, r22)
    s0 = tl.load(scales + g * 3, mask=inside, other=0.0)
    s1 = tl.load(scales + g * 3 + 1, mask=inside, other=0.0)
    s2 = tl.load(scales + g * 3 + 2, mask=inside, other=0.0)
    u = (tl.load(camera + 12) * x + tl.load(camera + 13) * y) * inverse + tl.load(camera + 14)
    v = (tl.load(camera + 15) * x + tl.load(camera + 16) * y) * inverse + tl.load(camera + 17)
    return beyond, z, u, v, a0 * s0, a1 * s1, a2 * s2, b0 * s0, b1 * s1, b2 * s2


@triton.jit
def _largest(xx, xy, yy):
    """The larger eigenvalue of a covariance; no square overflows."""
    half = 0.5 * (xx - yy)
    peak = tl.maximum(tl.abs(half), tl.abs(xy))
    scale = tl.where(peak > 0.0, peak, 1.0)
    return 0.5 * (xx + yy) + scale * tl.sqrt(half / scale * (half / scale) + xy / scale * (xy / scale))


@triton.jit(do_not_specialize=["height", "width", "n", "blocks"])
def find_visible(
    means, quats, scales, cameras, near, eps2d, height, width, n, blocks, flags, counts, BLOCK: tl.constexpr
):  # fmt: skip
    """Which pairs (camera, Gaussian) are visible: the footprint, out to the cutoff, touches the image."""
    b, c = tl.program_id(0), tl.program_id(1)
    g = b * BLOCK + tl.arange(0, BLOCK)
    inside = g < n
    beyond, _, u, v, a0, a1, a2, b0, b1, b2 = _footprint(cameras + c * _WIDTH, means, quats, scales, g, inside, near)
    xx, xy, yy, det = variances(a0, a1, a2, b0, b1, b2, eps2d)
    reach = tl.load(cameras + c * _WIDTH + _CUTOFF)
    rx, ry = reach * tl.sqrt(xx), reach * tl.sqrt(yy)
    finite = flags + tl.num_programs(1).to(tl.int64) * n
    touches = inside & beyond & (tl.load(finite + g, mask=inside, other=0) > 0)
    touches &= (det > 0.0) & is_finite(det + _largest(xx, xy, yy) + u + v)
    touches &= (u + rx > -0.5) & (u - rx < width - 0.5) & (v + ry > -0.5) & (v - ry < height - 0.5)
    tl.store(flags + c.to(tl.int64) * n + g, touches.to(tl.int8), mask=inside)
    tl.store(counts + c * blocks + b, tl.sum(touches.to(tl.int64), 0))


@triton.jit(do_not_specialize=["count", "n", "blocks"])
def number_rows(cameras, count, n, blocks, counts, numbers, BLOCK: tl.constexpr):
    """Where the rows of each block begin, in place of its count; and `numbers`, but for the entries. One program."""
    i = tl.arange(0, BLOCK)
    finite = tl.zeros((BLOCK,), tl.int64)
    first = 0
    while first < blocks:
        finite += tl.load(counts + count * blocks + first + i, mask=first + i < blocks, other=0)
        first += BLOCK
    tl.store(numbers + count, n - tl.sum(finite, 0))
    begin = tl.sum(finite * 0, 0)
    covered = begin + 1
    c = 0
    while c < count:
        row = counts + c * blocks
        first = 0
        while first < blocks:
            inside = first + i < blocks
            added = tl.load(row + first + i, mask=inside, other=0)
            tl.store(row + first + i, begin + tl.cumsum(added, 0) - added, mask=inside)
            begin += tl.sum(added, 0)
            first += BLOCK
        tl.store(numbers + c, begin)
        covered = tl.minimum(covered, tl.load(cameras + c * _WIDTH + _COVERED).to(tl.int64))
        c += 1
    tl.store(numbers + count + 1, covered)


@triton.jit
def _rows(flags, counts, b, c, g, n, inside, blocks):
    """Which Gaussians of a block a camera sees, and their rows."""
    visible = inside & (tl.load(flags + c.to(tl.int64) * n + g, mask=inside, other=0) > 0)
    before = tl.load(counts + c * blocks + b)
    return visible, before + tl.cumsum(visible.to(tl.int32), 0) - 1


@triton.jit
def _direction(camera, mx, my, mz):
    """Unit vector from the camera's centre, and 1 / distance."""
    x, y, z = mx - tl.load(camera + 22), my - tl.load(camera + 23), mz - tl.load(camera + 24)
    peak = tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z))  # squares of 1e20 would overflow
    x, y, z = x / peak, y / peak, z / peak
    norm = tl.sqrt(x * x + y * y + z * z)
    return x / norm, y / norm, z / norm, 1.0 / norm / peak


@triton.jit(do_not_specialize=["n", "blocks", "views"])
def list_visible(
    means, quats, scales, opacities, colors, cameras, flags, counts, near, eps2d, n, blocks, views, means2d, factors,
    depths, alphas, rgb, radii, camera_ids, ids,
    BANDS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write what is visible to its row: the fields of `kgs.ProjectedGaussians`."""
    b, c = tl.program_id(0), tl.program_id(1)
    camera = cameras + c * _WIDTH
    g = b * BLOCK + tl.arange(0, BLOCK)
    visible, m = _rows(flags, counts, b, c, g, n, g < n, blocks)
    _, z, u, v, a0, a1, a2, b0, b1, b2 = _footprint(camera, means, quats, scales, g, visible, near)
    xx, xy, yy, _ = variances(a0, a1, a2, b0, b1, b2, eps2d)
    tl.store(means2d + m * 2, u, mask=visible)
    tl.store(means2d + m * 2 + 1, v, mask=visible)
    tl.store(factors + m * 6, a0, mask=visible)
    tl.store(factors + m * 6 + 1, a1, mask=visible)
    tl.store(factors + m * 6 + 2, a2, mask=visible)
    tl.store(factors + m * 6 + 3, b0, mask=visible)
    tl.store(factors + m * 6 + 4, b1, mask=visible)
    tl.store(factors + m * 6 + 5, b2, mask=visible)
    tl.store(depths + m, z, mask=visible)
    tl.store(radii + m, tl.ceil(3.0 * tl.sqrt(_largest(xx, xy, yy))), mask=visible)
    row = tl.minimum(c, views - 1) * n
    tl.store(alphas + m, tl.load(opacities + row + g, mask=visible, other=0.0), mask=visible)
    tl.store(camera_ids + m, c + g * 0, mask=visible)
    tl.store(ids + m, g, mask=visible)
    if BANDS > 0:
        mx = tl.load(means + g * 3, mask=visible, other=0.0)
        my = tl.load(means + g * 3 + 1, mask=visible, other=0.0)
        mz = tl.load(means + g * 3 + 2, mask=visible, other=0.0)
        x, y, z, _ = _direction(camera, mx, my, mz)
        red, green, blue = evaluate(colors, g, visible, x, y, z, BANDS)
        tl.store(rgb + m * 3, tl.where(red < 0.0, 0.0, red), mask=visible)
        tl.store(rgb + m * 3 + 1, tl.where(green < 0.0, 0.0, green), mask=visible)
        tl.store(rgb + m * 3 + 2, tl.where(blue < 0.0, 0.0, blue), mask=visible)


@triton.jit
def _turned_back(a0, a1, a2, b0, b1, b2, r00, r01, r02, r10, r11, r12, r20, r21, r22):
    """The product of two rows with the transposed rotation: from dL/d(J W R) to dL/d(J W)."""
    return _turned(a0, a1, a2, b0, b1, b2, r00, r10, r20, r01, r11, r21, r02, r12, r22)


@triton.jit
def _quaternion_gradient(w, x, y, z, inverse, a0, a1, a2, b0, b1, b2, t0, t1, t2, u0, u1, u2):
    """From dL/d(J W R), rows t and u, to the quaternion, along the unit sphere; a and b are the rows of J W."""
    r00, r01, r02 = a0 * t0 + b0 * u0, a0 * t1 + b0 * u1, a0 * t2 + b0 * u2
    r10, r11, r12 = a1 * t0 + b1 * u0, a1 * t1 + b1 * u1, a1 * t2 + b1 * u2
    r20, r21, r22 = a2 * t0 + b2 * u0, a2 * t1 + b2 * u1, a2 * t2 + b2 * u2
    px, py, pz, sxy, sxz, syz = r21 - r12, r02 - r20, r10 - r01, r01 + r10, r02 + r20, r12 + r21
    dw = 2.0 * (x * px + y * py + z * pz)
    dx = 2.0 * (w * px - 2.0 * x * (r11 + r22) + y * sxy + z * sxz)
    dy = 2.0 * (w * py - 2.0 * y * (r00 + r22) + x * sxy + z * syz)
    dz = 2.0 * (w * pz - 2.0 * z * (r00 + r11) + x * sxz + y * syz)
    along = w * dw + x * dx + y * dy + z * dz
    return (
        (dw - along * w) * inverse,
        (dx - along * x) * inverse,
        (dy - along * y) * inverse,
        (dz - along * z) * inverse,
    )


@triton.jit
def _point_gradient(camera, x, y, z, u0, u1, u2, v0, v1, v2, g_u, g_v, g_depth):
    """From dL/d(J W), rows u and v, the pixel and the depth to the centre in camera axes, and to J by rows."""
    inverse = 1.0 / z
    j00, j01, j02, j10, j11, j12, tx, ty = _jacobian(camera, x, y, inverse)
    k00, k01, k10, k11 = tl.load(camera + 12), tl.load(camera + 13), tl.load(camera + 15), tl.load(camera + 16)
    h00, h01, h02 = _to_camera(camera, u0, u1, u2)
    h10, h11, h12 = _to_camera(camera, v0, v1, v2)
    px, py = (k00 * g_u + k10 * g_v) * inverse, (k01 * g_u + k11 * g_v) * inverse
    gx, gy = px, py
    gz = g_depth - (px * x + py * y) * inverse
    gz -= (h00 * j00 + h01 * j01 + h02 * j02 + h10 * j10 + h11 * j11 + h12 * j12) * inverse
    free = (x * inverse >= tl.load(camera + 18)) & (x * inverse <= tl.load(camera + 19))
    t = tl.where(free, -(k00 * h02 + k10 * h12) * inverse * inverse, 0.0)
    gx, gz = gx + t, gz - t * tx
    free = (y * inverse >= tl.load(camera + 20)) & (y * inverse <= tl.load(camera + 21))
    t = tl.where(free, -(k01 * h02 + k11 * h12) * inverse * inverse, 0.0)
    gy, gz = gy + t, gz - t * ty
    return gx, gy, gz, h00, h01, h02, h10, h11, h12


@triton.jit
def _limit_gradients(camera, x, y, inverse, h02, h12):
    """From the last column of dL/dJ to the principal point, by limits of the tangents, where these are reached."""
    k00, k01, k10, k11 = tl.load(camera + 12), tl.load(camera + 13), tl.load(camera + 15), tl.load(camera + 16)
    tx, ty = x * inverse, y * inverse
    over_x = (tx < tl.load(camera + 18)) | (tx > tl.load(camera + 19))
    over_y = (ty < tl.load(camera + 20)) | (ty > tl.load(camera + 21))
    by_x = tl.where(over_x, (k00 * h02 + k10 * h12) * inverse / k00, 0.0)
    by_y = tl.where(over_y, (k01 * h02 + k11 * h12) * inverse / k11, 0.0)
    return by_x, by_y


@triton.jit
def _by_direction(gx, gy, gz, x, y, z, red, green, blue, r, g, b, k: tl.constexpr):
    """Add to dL/d direction what band k, with colour (r, g, b), contributes; the first contributes nothing."""
    if k > 0:
        bx, by, bz = basis_gradient(x, y, z, red * r + green * g + blue * b, k)
        gx, gy, gz = gx + bx, gy + by, gz + bz
    return gx, gy, gz


@triton.jit
def _color_gradients(
    camera, mx, my, mz, colors, g, visible, red, green, blue, d_colors, written,
    BANDS: tl.constexpr, WRITE: tl.constexpr, ADD: tl.constexpr,
):  # fmt: skip
    """The colour's contribution to the gradient of the centre, from that of red, green and blue.

    With `WRITE` the gradients of the harmonics are stored, or with `ADD` added to what is there.
    """
    x, y, z, inverse = _direction(camera, mx, my, mz)
    x, y, z = tl.where(visible, x, 0.0), tl.where(visible, y, 0.0), tl.where(visible, z, 0.0)
    r, g_, b = evaluate(colors, g, visible, x, y, z, BANDS)
    red, green, blue = tl.where(r < 0.0, 0.0, red), tl.where(g_ < 0.0, 0.0, green), tl.where(b < 0.0, 0.0, blue)
    gx, gy, gz = red * 0.0, red * 0.0, red * 0.0
    row = g.to(tl.int64) * (3 * BANDS)
    out = d_colors + row
    for k in tl.static_range(0, BANDS // 4 * 4, 4):
        if WRITE:
            v0, v1, v2, v3 = basis(x, y, z, k), basis(x, y, z, k + 1), basis(x, y, z, k + 2), basis(x, y, z, k + 3)
            put_four(out + 3 * k, v0 * red, v0 * green, v0 * blue, v1 * red, written, ADD)
            put_four(out + 3 * k + 4, v1 * green, v1 * blue, v2 * red, v2 * green, written, ADD)
            put_four(out + 3 * k + 8, v2 * blue, v3 * red, v3 * green, v3 * blue, written, ADD)
        r0, g0, b0, r1, g1, b1, r2, g2, b2, r3, g3, b3 = load_bands(colors + row + 3 * k, visible)
        gx, gy, gz = _by_direction(gx, gy, gz, x, y, z, red, green, blue, r0, g0, b0, k)
        gx, gy, gz = _by_direction(gx, gy, gz, x, y, z, red, green, blue, r1, g1, b1, k + 1)
        gx, gy, gz = _by_direction(gx, gy, gz, x, y, z, red, green, blue, r2, g2, b2, k + 2)
        gx, gy, gz = _by_direction(gx, gy, gz, x, y, z, red, green, blue, r3, g3, b3, k + 3)
    for k in tl.static_range(BANDS // 4 * 4, BANDS):
        if WRITE:
            v = basis(x, y, z, k)
            put(out + 3 * k, v * red, written, ADD)
            put(out + 3 * k + 1, v * green, written, ADD)
            put(out + 3 * k + 2, v * blue, written, ADD)
        r = tl.load(colors + row + 3 * k, mask=visible, other=0.0)
        g_ = tl.load(colors + row + 3 * k + 1, mask=visible, other=0.0)
        b = tl.load(colors + row + 3 * k + 2, mask=visible, other=0.0)
        gx, gy, gz = _by_direction(gx, gy, gz, x, y, z, red, green, blue, r, g_, b, k)
    along = gx * x + gy * y + gz * z
    return (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse


@triton.jit
def _total(out, value, visible):
    """Store the sum over the Gaussians that are visible."""
    tl.store(out, tl.sum(tl.where(visible, value, 0.0), 0))


@triton.jit
def _pose_totals(out, i: tl.constexpr, camera, moved, j, h, mx, my, mz, u0, u1, u2, v0, v1, v2, wx, wy, wz, visible):
    """The gradient of row i of a pose: by the point, by J W, and by the direction of the colours."""
    turned = tl.load(camera + 26 + i) * wx + tl.load(camera + 29 + i) * wy + tl.load(camera + 32 + i) * wz
    _total(out + 4 * i, moved * mx + j * u0 + h * v0 + turned * tl.load(camera + 22), visible)
    _total(out + 4 * i + 1, moved * my + j * u1 + h * v1 + turned * tl.load(camera + 23), visible)
    _total(out + 4 * i + 2, moved * mz + j * u2 + h * v2 + turned * tl.load(camera + 24), visible)
    _total(out + 4 * i + 3, moved + turned, visible)


@triton.jit(do_not_specialize=["c", "n", "blocks", "views"])
def footprint_gradients(
    c, means, quats, scales, colors, cameras, flags, counts, n, blocks, views, g_means2d, g_factors, g_depths, g_alphas,
    g_rgb, d_means, d_quats, d_scales, d_opacities, d_colors, totals,
    BANDS: tl.constexpr, WITH_DEPTHS: tl.constexpr, WITH_COLORS: tl.constexpr, WITH_CAMERA: tl.constexpr,
    ADD: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """From gradients of what camera c sees to those of all Gaussians; `ADD`: added to those by the cameras before.

    With `WITH_CAMERA` also those of the camera, `totals` of each block of Gaussians: pose (3, 4), intrinsics (3, 3).
    Without `WITH_DEPTHS` those of the depths are 0. Of a Gaussian whose gradients are all 0, as of what lies behind an
    opaque surface, nothing is read.
    """
    b = tl.program_id(0)
    camera = cameras + c * _WIDTH
    g = b * BLOCK + tl.arange(0, BLOCK)
    inside = g < n
    visible, m = _rows(flags, counts, b, c, g, n, inside, blocks)
    t0, t1, t2, t3, t4, t5 = load_factors(g_factors, m, visible)
    g_u = tl.load(g_means2d + m * 2, mask=visible, other=0.0)
    g_v = tl.load(g_means2d + m * 2 + 1, mask=visible, other=0.0)
    alpha = tl.load(g_alphas + m, mask=visible, other=0.0)
    g_depth = tl.zeros((BLOCK,), tl.float32)
    if WITH_DEPTHS:
        g_depth = tl.load(g_depths + m, mask=visible, other=0.0)
    red, green, blue = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    if BANDS > 0:
        red = tl.load(g_rgb + m * 3, mask=visible, other=0.0)
        green = tl.load(g_rgb + m * 3 + 1, mask=visible, other=0.0)
        blue = tl.load(g_rgb + m * 3 + 2, mask=visible, other=0.0)
    total = tl.abs(t0) + tl.abs(t1) + tl.abs(t2) + tl.abs(t3) + tl.abs(t4) + tl.abs(t5) + tl.abs(g_u) + tl.abs(g_v)
    total += tl.abs(alpha) + tl.abs(g_depth) + tl.abs(red) + tl.abs(green) + tl.abs(blue)
    visible = visible & (total != 0.0)  # what is not a number stays
    written = visible if ADD else inside
    mx, my, mz, x, y, z = _camera_point(camera, means, g, visible)
    z = tl.where(visible, z, 1.0)
    inverse = 1.0 / z
    j00, j01, j02, j10, j11, j12, tx, ty = _jacobian(camera, x, y, inverse)
    a0, a1, a2 = _to_world(camera, j00, j01, j02)
    b0, b1, b2 = _to_world(camera, j10, j11, j12)
    qw, qx, qy, qz, by_norm, r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(quats, g, visible)
    f0, f1, f2, f3, f4, f5 = _turned(a0, a1, a2, b0, b1, b2, r00, r01, r02, r10, r11, r12, r20, r21, r22)
    put(d_scales + g * 3, t0 * f0 + t3 * f3, written, ADD)
    put(d_scales + g * 3 + 1, t1 * f1 + t4 * f4, written, ADD)
    put(d_scales + g * 3 + 2, t2 * f2 + t5 * f5, written, ADD)
    s0 = tl.load(scales + g * 3, mask=visible, other=0.0)
    s1 = tl.load(scales + g * 3 + 1, mask=visible, other=0.0)
    s2 = tl.load(scales + g * 3 + 2, mask=visible, other=0.0)
    t0, t1, t2, t3, t4, t5 = t0 * s0, t1 * s1, t2 * s2, t3 * s0, t4 * s1, t5 * s2
    dw, dx, dy, dz = _quaternion_gradient(qw, qx, qy, qz, by_norm, a0, a1, a2, b0, b1, b2, t0, t1, t2, t3, t4, t5)
    put_four(d_quats + g * 4, dw, dx, dy, dz, written, ADD)
    u0, u1, u2, v0, v1, v2 = _turned_back(t0, t1, t2, t3, t4, t5, r00, r01, r02, r10, r11, r12, r20, r21, r22)
    gx, gy, gz, h00, h01, h02, h10, h11, h12 = _point_gradient(
        camera, x, y, z, u0, u1, u2, v0, v1, v2, g_u, g_v, g_depth
    )
    wx, wy, wz = gx * 0.0, gx * 0.0, gx * 0.0
    if BANDS > 0:
        wx, wy, wz = _color_gradients(
            camera, mx, my, mz, colors, g, visible, red, green, blue, d_colors, written, BANDS, WITH_COLORS, ADD
        )
    px, py, pz = _to_world(camera, gx, gy, gz)
    put(d_means + g * 3, tl.where(visible, px + wx, 0.0), written, ADD)
    put(d_means + g * 3 + 1, tl.where(visible, py + wy, 0.0), written, ADD)
    put(d_means + g * 3 + 2, tl.where(visible, pz + wz, 0.0), written, ADD)
    view = 0
    while view < views:  # each has its own opacities, or all have one
        own = (views == 1) | (view == c)
        put(d_opacities + view * n + g, tl.where(own, alpha, 0.0), written, ADD)
        view += 1
    if WITH_CAMERA:
        out = totals + b * 21
        _pose_totals(out, 0, camera, gx, j00, j10, mx, my, mz, u0, u1, u2, v0, v1, v2, wx, wy, wz, visible)
        _pose_totals(out, 1, camera, gy, j01, j11, mx, my, mz, u0, u1, u2, v0, v1, v2, wx, wy, wz, visible)
        _pose_totals(out, 2, camera, gz, j02, j12, mx, my, mz, u0, u1, u2, v0, v1, v2, wx, wy, wz, visible)
        u = (tl.load(camera + 12) * x + tl.load(camera + 13) * y) * inverse + tl.load(camera + 14)
        v = (tl.load(camera + 15) * x + tl.load(camera + 16) * y) * inverse + tl.load(camera + 17)
        g_u, g_v, g_w = g_u * inverse, g_v * inverse, -(g_u * u + g_v * v) * inverse
        by_x, by_y = _limit_gradients(camera, x, y, inverse, h02, h12)
        _total(out + 12, g_u * x + (h00 - h02 * tx) * inverse + by_x * tx, visible)
        _total(out + 13, g_u * y + (h01 - h02 * ty) * inverse, visible)
        _total(out + 14, g_u * z + by_x, visible)
        _total(out + 15, g_v * x + (h10 - h12 * tx) * inverse, visible)
        _total(out + 16, g_v * y + (h11 - h12 * ty) * inverse + by_y * ty, visible)
        _total(out + 17, g_v * z + by_y, visible)
        _total(out + 18, g_w * x, visible)
        _total(out + 19, g_w * y, visible)
        _total(out + 20, g_w * z, visible)
