"""Front-to-back compositing of the lists of tiles, and its gradient; formulas as in `kgs.backends.torch`.

A program composites a tile, P pixels by K entries at a time, for a block of `FEATURES` features. Along the entries of a
chunk, scans give the transmittance before and after each, and V behind each; nothing is divided. T at the beginning of
each chunk is kept, and the backward pass computes the alphas of a chunk again. It writes a row of moments for each
entry, where no other program writes, in the order of the Gaussians: `sum_entries` adds up neighbouring rows in a fixed
order. There are no atomics.

Arrays, for M projected Gaussians, T tiles and E entries:

    table        (M, 8)   in depth order: log2 o, x, y, two whitening vectors, depth
    features     (M, F)   as they were given
    order        (M,)     their rows in depth order
    entries      (E,)     for each tile its Gaussians from front to back, as positions in `order`
    slots        (E,)     which slot each entry has if they are sorted by Gaussian
    offsets      (T + 1,) where the entries of each tile begin
    starts       (E / K + T, P) T at the beginning of each chunk
    reached      (T,)     how many entries of a tile were composited
    moments      (E, ROW) six moments of dL/d ln alpha about the centre, dL/d features, |dL/d mean|
"""

import triton
import triton.language as tl

from .footprint_kernels import is_finite, load_factors, put, variances

SIZE = 8  # side of a tile
K = 8  # entries in a chunk: more spill registers
FEATURES = 4  # of a block
ROW = 12  # numbers of a row: 6 + FEATURES + 2

_S: tl.constexpr = tl.constexpr(SIZE)
_P: tl.constexpr = tl.constexpr(SIZE * SIZE)
_K: tl.constexpr = tl.constexpr(K)
_F: tl.constexpr = tl.constexpr(FEATURES)
_ROW: tl.constexpr = tl.constexpr(ROW)
_ALPHA_MAX: tl.constexpr = tl.constexpr(0.99)
_FLOOR: tl.constexpr = tl.constexpr(-126.0)  # of the exponent to base 2: below it floats are denormal
_TWICE_LN2: tl.constexpr = tl.constexpr(1.3862943611198906)  # of the derivative of that exponent


@triton.jit
def _compose_transmittances(after1, before1, after2, before2):
    """Of some layers, the transmittance behind them, and before the last of them."""
    return after1 * after2, after1 * before2


@triton.jit
def _compose_behind(m1, b1, inner_m1, inner_b1, m2, b2, inner_m2, inner_b2):
    """V -> m V + b through some layers, from the back; and the same without the foremost."""
    return m1 * m2, m2 * b1 + b2, m1 * inner_m2, inner_m2 * b1 + inner_b2


@triton.jit
def _pixels(tile, columns, rows):
    """Camera of a tile, and the coordinates of its pixels."""
    p = tl.arange(0, _P)
    inside = tile % (columns * rows)
    x = (inside % columns) * _S + p % _S
    y = (inside // columns) * _S + p // _S
    return (tile // (columns * rows)).to(tl.int64), x, y


@triton.jit
def _alphas(table, ranks, listed, x, y, threshold):
    """Alphas of K entries at P pixels, and from the centres to the pixels."""
    row = table + ranks * 8
    o = tl.load(row, mask=listed, other=float("-inf"))[:, None]
    dx = x[None, :] - tl.load(row + 1, mask=listed, other=0.0)[:, None]
    dy = y[None, :] - tl.load(row + 2, mask=listed, other=0.0)[:, None]
    ax = tl.load(row + 3, mask=listed, other=0.0)[:, None]
    ay = tl.load(row + 4, mask=listed, other=0.0)[:, None]
    bx = tl.load(row + 5, mask=listed, other=0.0)[:, None]
    by = tl.load(row + 6, mask=listed, other=0.0)[:, None]
    va = ax * dx + ay * dy
    vb = bx * dx + by * dy
    alpha = tl.minimum(tl.exp2(tl.maximum(o - va * va - vb * vb, _FLOOR)), _ALPHA_MAX)
    return tl.where((alpha >= threshold) & listed[:, None], alpha, 0.0), dx, dy


@triton.jit
def _transmittances(alpha, start, stop):
    """The transmittance before and after each of K layers; 0 behind the stop."""
    keep = 1.0 - alpha
    after, before = tl.associative_scan((keep, keep * 0.0 + 1.0), 0, _compose_transmittances)
    after = start[None, :] * after
    before = start[None, :] * before
    return tl.where(before >= stop, before, 0.0), tl.where(after >= stop, after, 0.0)


@triton.jit
def _exists(f, channels, like):
    """Whether there is a feature f, in the shape of `like`."""
    return like * 0 + f < channels


@triton.jit
def _feature(features, ids, listed, f, width):
    """Feature f of K entries; 0 where there is none."""
    return tl.load(features + ids * width + f, mask=listed & _exists(f, width, ids), other=0.0)[:, None]


@triton.jit(do_not_specialize=["first_tile", "columns", "rows", "height", "width", "channels"])
def composite_forward(
    table, features, order, entries, offsets, first_tile, columns, rows, height, width, channels, threshold, stop,
    starts, reached, sums, transmittance, depths,
    KEEP: tl.constexpr, IMAGES: tl.constexpr, MEDIAN: tl.constexpr,
):  # fmt: skip
    """Sums over layers, transmittance and median depth, straight into the images, with `IMAGES`."""
    t = tl.program_id(0)
    block = tl.program_id(1)
    camera, column, row = _pixels(first_tile + t, columns, rows)
    x, y = column.to(tl.float32), row.to(tl.float32)
    inside = (column < width) & (row < height)
    T = tl.where(inside, 1.0, 0.0)  # pixels beyond the image are opaque
    f0 = block * _F
    sum0 = T * 0.0
    sum1 = T * 0.0
    sum2 = T * 0.0
    sum3 = T * 0.0
    median = T * 0.0
    first = tl.load(offsets + t)
    last = tl.load(offsets + t + 1)
    k = tl.arange(0, _K)
    p = tl.arange(0, _P)
    chunk = first // _K + t
    e = first
    open_ = 1
    while (e < last) & (open_ > 0):
        if KEEP:  # noqa: SIM102 - a constant and a number of the device do not go into one condition
            if block == 0:
                tl.store(starts + chunk * _P + p, T)
        chunk += 1
        listed = e + k < last
        ranks = tl.load(entries + e + k, mask=listed, other=0)
        ids = tl.load(order + ranks, mask=listed, other=0)
        alpha, _, _ = _alphas(table, ranks, listed, x, y, threshold)
        before, after = _transmittances(alpha, T, stop)
        weight = alpha * before
        sum0 += tl.sum(weight * _feature(features, ids, listed, f0, channels), 0)
        sum1 += tl.sum(weight * _feature(features, ids, listed, f0 + 1, channels), 0)
        sum2 += tl.sum(weight * _feature(features, ids, listed, f0 + 2, channels), 0)
        sum3 += tl.sum(weight * _feature(features, ids, listed, f0 + 3, channels), 0)
        if MEDIAN:
            depth = tl.load(table + ranks * 8 + 7, mask=listed, other=0.0)[:, None]
            median += tl.sum(tl.where((before >= 0.5) & (after < 0.5), depth, 0.0), 0)
        T = tl.min(after, 0)  # T never grows
        open_ = tl.max((T > 0.0).to(tl.int32), 0)
        e += _K
    pixel = row * width + column
    size = height * width
    if block == 0:
        tl.store(reached + t, tl.minimum(e, last) - first)
    if IMAGES:
        if block == 0:
            tl.store(transmittance + camera * size + pixel, T, mask=inside)
            if MEDIAN:
                tl.store(depths + camera * size + pixel, median, mask=inside)
        image = sums + (camera * channels + f0) * size + pixel
        tl.store(image, sum0, mask=inside & _exists(f0, channels, pixel))
        tl.store(image + size, sum1, mask=inside & _exists(f0 + 1, channels, pixel))
        tl.store(image + size * 2, sum2, mask=inside & _exists(f0 + 2, channels, pixel))
        tl.store(image + size * 3, sum3, mask=inside & _exists(f0 + 3, channels, pixel))


@triton.jit(do_not_specialize=["first_tile", "columns", "rows", "height", "width", "channels", "f0"])
def composite_backward(
    table, features, order, entries, slots, offsets, first_tile, columns, rows, height, width, channels, threshold,
    stop, starts, reached, grads, grad_transmittance, f0, moments,
    ABSOLUTE: tl.constexpr,
):  # fmt: skip
    """For each entry the moments, dL/d features of the block that begins at `f0`, and |dL/d mean|: `moments`."""
    t = tl.program_id(0)
    camera, column, row = _pixels(first_tile + t, columns, rows)
    x, y = column.to(tl.float32), row.to(tl.float32)
    inside = (column < width) & (row < height)
    pixel = row * width + column
    size = height * width
    image = grads + (camera * channels + f0) * size + pixel
    grad0 = tl.load(image, mask=inside & _exists(f0, channels, pixel), other=0.0)
    grad1 = tl.load(image + size, mask=inside & _exists(f0 + 1, channels, pixel), other=0.0)
    grad2 = tl.load(image + size * 2, mask=inside & _exists(f0 + 2, channels, pixel), other=0.0)
    grad3 = tl.load(image + size * 3, mask=inside & _exists(f0 + 3, channels, pixel), other=0.0)
    behind = tl.load(grad_transmittance + camera * size + pixel, mask=inside & (pixel * 0 + f0 == 0), other=0.0)
    first = tl.load(offsets + t)
    count = tl.load(reached + t)
    k = tl.arange(0, _K)
    p = tl.arange(0, _P)
    chunk = (count + _K - 1) // _K - 1
    while chunk >= 0:
        e = first + chunk * _K
        listed = chunk * _K + k < count
        ranks = tl.load(entries + e + k, mask=listed, other=0)
        ids = tl.load(order + ranks, mask=listed, other=0)
        start = tl.load(starts + (first // _K + t + chunk) * _P + p)
        alpha, dx, dy = _alphas(table, ranks, listed, x, y, threshold)
        before, after = _transmittances(alpha, start, stop)
        weight = alpha * before
        value = _feature(features, ids, listed, f0, channels) * grad0[None, :]
        value += _feature(features, ids, listed, f0 + 1, channels) * grad1[None, :]
        value += _feature(features, ids, listed, f0 + 2, channels) * grad2[None, :]
        value += _feature(features, ids, listed, f0 + 3, channels) * grad3[None, :]
        # V_k = alpha v + (1 - alpha) V_{k+1}, and V_{k+1} is 0 behind the stop
        before_stop = after > 0.0
        keep = tl.where(before_stop, 1.0 - alpha, 0.0)
        one, zero = keep * 0.0 + 1.0, keep * 0.0
        m, b, inner_m, inner_b = tl.associative_scan((keep, alpha * value, one, zero), 0, _compose_behind, reverse=True)
        later = tl.where(before_stop, inner_m * behind[None, :] + inner_b, 0.0)
        behind = tl.sum(tl.where(k[:, None] == 0, m * behind[None, :] + b, 0.0), 0)
        slope = tl.where(alpha < _ALPHA_MAX, weight * (value - later), 0.0)
        by_x, by_y = slope * dx, slope * dy
        out = moments + tl.load(slots + e + k, mask=listed, other=0) * _ROW
        tl.store(out, tl.sum(slope, 1), mask=listed)
        tl.store(out + 1, tl.sum(by_x, 1), mask=listed)
        tl.store(out + 2, tl.sum(by_y, 1), mask=listed)
        tl.store(out + 3, tl.sum(by_x * dx, 1), mask=listed)
        tl.store(out + 4, tl.sum(by_x * dy, 1), mask=listed)
        tl.store(out + 5, tl.sum(by_y * dy, 1), mask=listed)
        tl.store(out + 6, tl.sum(weight * grad0[None, :], 1), mask=listed)
        tl.store(out + 7, tl.sum(weight * grad1[None, :], 1), mask=listed)
        tl.store(out + 8, tl.sum(weight * grad2[None, :], 1), mask=listed)
        tl.store(out + 9, tl.sum(weight * grad3[None, :], 1), mask=listed)
        if ABSOLUTE:
            base = table + ranks * 8
            ax = tl.load(base + 3, mask=listed, other=0.0)[:, None]
            ay = tl.load(base + 4, mask=listed, other=0.0)[:, None]
            bx = tl.load(base + 5, mask=listed, other=0.0)[:, None]
            by = tl.load(base + 6, mask=listed, other=0.0)[:, None]
            va = ax * dx + ay * dy
            vb = bx * dx + by * dy
            tl.store(out + 10, tl.sum(tl.abs(slope * (va * ax + vb * bx)), 1) * _TWICE_LN2, mask=listed)
            tl.store(out + 11, tl.sum(tl.abs(slope * (va * ay + vb * by)), 1) * _TWICE_LN2, mask=listed)
        chunk -= 1


@triton.jit
def _column(values, i: tl.constexpr):
    """Column i of four."""
    return tl.sum(tl.where(tl.arange(0, 4)[None, :] == i, values, 0.0), 1)


@triton.jit(do_not_specialize=["n", "channels", "f0"])
def sum_entries(
    order, begins, moments, factors, opacities, eps2d, n, channels, f0, d_means2d, d_factors, d_opacities, d_features,
    d_absolute,
    MOMENTS: tl.constexpr, WITH_FEATURES: tl.constexpr, ABSOLUTE: tl.constexpr,
    ADD: tl.constexpr, ADD_FEATURES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add up the rows of each Gaussian, and turn its moments into gradients, as `covariance.moment_gradients` does.

    A Gaussian's rows lie side by side, from `begins[i]` on. A lane adds up those of one Gaussian, four numbers at a
    time; where a few Gaussians of a block have most of its rows, all lanes add up those of each. `ADD` adds to the
    gradients that are there, of another block of features or of another row slice, where there is something to add.
    """
    lane = tl.arange(0, BLOCK)
    i = tl.program_id(0) * BLOCK + lane
    inside = i < n
    begin = tl.load(begins + i, mask=inside, other=0)
    count = (tl.load(begins + i + 1, mask=inside, other=0) - begin).to(tl.int32)
    limit = tl.minimum(16 + tl.sum(count, 0) // 8, 256)
    short = count <= limit
    number = tl.arange(0, 4)[None, :]
    sums0 = tl.zeros((BLOCK, 4), tl.float32)
    sums1, sums2 = sums0, sums0
    rows = moments + begin[:, None] * _ROW + number
    longest = tl.max(tl.where(short, count, 0), 0)
    k = 0
    while k < longest:
        there = (short & (k < count))[:, None]
        sums0 += tl.load(rows, mask=there, other=0.0)
        sums1 += tl.load(rows + 4, mask=there, other=0.0)
        sums2 += tl.load(rows + 8, mask=there, other=0.0)
        rows += _ROW
        k += 1
    one = tl.min(tl.where(short, BLOCK, lane), 0)
    while one < BLOCK:
        part0 = tl.zeros((BLOCK, 4), tl.float32)
        part1, part2 = part0, part0
        left = tl.sum(tl.where(lane == one, count, 0), 0)
        rows = moments + (tl.sum(tl.where(lane == one, begin, 0), 0) + lane)[:, None] * _ROW + number
        while left > 0:
            there = (lane < left)[:, None]
            part0 += tl.load(rows, mask=there, other=0.0)
            part1 += tl.load(rows + 4, mask=there, other=0.0)
            part2 += tl.load(rows + 8, mask=there, other=0.0)
            rows += BLOCK * _ROW
            left -= BLOCK
        here = (lane == one)[:, None]
        sums0 += tl.where(here, tl.sum(part0, 0)[None, :], 0.0)
        sums1 += tl.where(here, tl.sum(part1, 0)[None, :], 0.0)
        sums2 += tl.where(here, tl.sum(part2, 0)[None, :], 0.0)
        one = tl.min(tl.where(short | (lane <= one), BLOCK, lane), 0)
    listed = count > 0
    written = listed if ADD else inside
    g = tl.load(order + i, mask=inside, other=0)
    if WITH_FEATURES:
        out = d_features + g * channels + f0
        some = listed if ADD_FEATURES else inside
        put(out, _column(sums1, 2), some & _exists(f0, channels, i), ADD_FEATURES)
        put(out + 1, _column(sums1, 3), some & _exists(f0 + 1, channels, i), ADD_FEATURES)
        put(out + 2, _column(sums2, 0), some & _exists(f0 + 2, channels, i), ADD_FEATURES)
        put(out + 3, _column(sums2, 1), some & _exists(f0 + 3, channels, i), ADD_FEATURES)
    if ABSOLUTE:
        put(d_absolute + g * 2, _column(sums2, 2), written, ADD)
        put(d_absolute + g * 2 + 1, _column(sums2, 3), written, ADD)
    if MOMENTS:
        s0, sx, sy, sxx = _column(sums0, 0), _column(sums0, 1), _column(sums0, 2), _column(sums0, 3)
        sxy, syy = _column(sums1, 0), _column(sums1, 1)
        a0, a1, a2, b0, b1, b2 = load_factors(factors, g, written)
        xx, xy, yy, det = variances(a0, a1, a2, b0, b1, b2, eps2d)
        opacity = tl.load(opacities + g, mask=written, other=1.0)
        put(d_opacities + g, tl.where(listed, s0 / opacity, 0.0), written, ADD)
        curved = listed & is_finite(det)  # else it overflows: flat over the image
        r = 1.0 / det
        put(d_means2d + g * 2, tl.where(curved, (yy * sx - xy * sy) * r, 0.0), written, ADD)
        put(d_means2d + g * 2 + 1, tl.where(curved, (xx * sy - xy * sx) * r, 0.0), written, ADD)
        u, v, w = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        # det Q M without cancellation: rows e a + b x w and e b + w x a
        x0, x1, x2 = eps2d * a0 + b1 * w - b2 * v, eps2d * a1 + b2 * u - b0 * w, eps2d * a2 + b0 * v - b1 * u
        y0, y1, y2 = eps2d * b0 + v * a2 - w * a1, eps2d * b1 + w * a0 - u * a2, eps2d * b2 + u * a1 - v * a0
        _put_factors(d_factors + g * 6, x0, y0, r, xx, xy, yy, sxx, sxy, syy, curved, written, ADD)
        _put_factors(d_factors + g * 6 + 1, x1, y1, r, xx, xy, yy, sxx, sxy, syy, curved, written, ADD)
        _put_factors(d_factors + g * 6 + 2, x2, y2, r, xx, xy, yy, sxx, sxy, syy, curved, written, ADD)


@triton.jit
def _put_factors(out, x, y, r, xx, xy, yy, sxx, sxy, syy, curved, written, ADD: tl.constexpr):
    """A column of dL/dM: Q S Q M of the second moments S, where x and y are a column of det Q M."""
    x, y = x * r, y * r
    m, n = sxx * x + sxy * y, sxy * x + syy * y
    put(out, tl.where(curved, (yy * m - xy * n) * r, 0.0), written, ADD)
    put(out + 3, tl.where(curved, (xx * n - xy * m) * r, 0.0), written, ADD)
