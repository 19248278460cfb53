"""Front-to-back compositing of the lists of a band, and its gradient; formulas as in `kgs.backends.torch`.

A tile is P pixels, four times the `Lanes` of a kernel: four strips of two rows. Of the K entries of a chunk a strip
takes those that may reach it, see `find_strips`. T is kept at the beginning of every chunk; the backward pass goes from
chunk to chunk, back to front, and computes alphas and T of each again, with the same bits. Features come in blocks that
a kernel is compiled for: V is linear in the features and in dL/dT, so blocks are differentiated one after the other,
and their moments are added.

What the kernels take, for C cameras, T tiles of a band and blocks of F features:

    first_tile, offsets, entries, table   those of the `Band`
    grid                                  (rows, columns) of tiles of one image
    threshold, stop                       smaller alphas count as 0, and so does a smaller transmittance
    feature                               where the block of features begins
    channels                              any tuple of as many numbers as the block has features
    starts                                (chunks, P), T at the beginning of each chunk; or empty
    strips                                (chunks, STRIPS), what `find_strips` found for each chunk; or empty
    reached                               (T,), how many entries of each tile were composited
    transmittance, depths                 (C, H, W), the latter the median depth; or empty
    sums                                  (C, features, H, W); in the backward pass (members, ROW) of a block:
                                          six moments, dL/d features, and from ABSOLUTE on two sums of |dL/d mean|
    grads, grad_transmittance             (C, features, H, W) and (C, H, W), derivatives of the loss
"""

import math

import numpy as np

from kgs._support.compiled.kernel import HALF, ONE, ZERO, exp2, f32, inline, is_finite, jit, scratch
from kgs._support.compiled.lanes import (
    WIDTH,
    bits_above,
    columns,
    highest,
    load,
    lowest,
    magnitude,
    maximum,
    minimum,
    multiply_add,
    spread,
    store,
    total,
    totals,
    where_above,
    where_at_least,
)

from .binning_kernels import SIZE, variances

P = SIZE * SIZE
STRIPS = P // WIDTH
K = 32
WIDTHS = (3, 4, 8)  # of blocks of features
ROW = WIDTH  # numbers of a row of the table, and of sums of a member and a block
MOMENTS = 6
FEATURES = 8  # of a row, at most
ABSOLUTE = MOMENTS + FEATURES
TINY = 2.0**-125  # smaller alphas and T are 0: products with them would be denormal, and slow
_ALPHA_MAX = f32(0.99)
_FLOOR = f32(-126.0)  # of the exponent to base 2: below it floats are denormal
_CENTRE = f32(0.5 * (SIZE - 1))
TWICE_LN2 = f32(1.3862943611198906)  # of the derivative of the exponent to base 2, by the whitening vectors
_MARGIN, _MARGIN_FAR, _WIDER = f32(1e-3), f32(2.0**-30), f32(1.0 + 2.0**-9)  # see `find_strips`
_BLOCK = 64


@inline
def fill_pixels(pixels):
    """X and y of the pixels of a tile about its centre, `(2 P,)`."""
    for p in range(P):
        pixels[p] = f32(p % SIZE) - _CENTRE
        pixels[P + p] = f32(p // SIZE) - _CENTRE


@inline
def gather(table, entries, first, n, corner, feature, channels, layers):
    """Copy what a chunk needs, many reads that miss the caches at a time; centres are about that of the tile."""
    for k in range(n):
        row = table[entries[first + k]]
        store(layers, k * ROW, load(row, 0) - load(corner, 0))
        if feature > 0:
            for f in range(channels):
                layers[k * ROW + 7 + f] = row[7 + feature + f]


@inline
def find_strips(layers, n, log_threshold, strips):
    """Set bit k of `strips[s]`, for the n layers of a chunk, where layer k may reach strip s: elsewhere its alpha is 0.

    With log2 alpha = l - |v|^2, v = W (dx, dy), and `log_threshold` the log2 of the threshold, a layer reaches a pixel
    where |v|^2 <= l - log_threshold. On a row, dy is given, and |v|^2 is least at dx = -dy (w0 . w1) / (w0 . w0), w0
    and w1 being the columns of W, or at the end of the row that is closer to it. A strip is missed where both of its
    rows are.

    What is missed must be 0 with all roundings, so the bound is wider. Let M^2 = far_x^2 |w0|^2 + far_y^2 |w1|^2 with
    the largest |dx| and |dy| of the tile, and u = 2^-24. Here and in `alpha_of`, together, the error of v is below e =
    8 sqrt(2) u M, and |v|^2 >= (1 - t) |v + e|^2 - e^2 / t for any t; with t = 2^-10, e^2 / t is 2^-31 M^2. The other
    roundings, of the exponent, of 2^x and of `log_threshold`, are below 1e-4. A bound that is not a number or infinite
    is exceeded by nothing, and all strips are reached. In the forward pass a feature that is not finite therefore
    spreads to all pixels of the strips that its layer reaches, but not beyond.
    """
    for s in range(STRIPS):
        strips[s] = 0
    for first in range(0, n, WIDTH):
        exponent, x, y, ax, ay, bx, by, _ = columns(layers, first * ROW)
        xx, yy = ax * ax + bx * bx, ay * ay + by * by
        slope = (ax * ay + bx * by) / xx
        far_x, far_y = magnitude(x) + _CENTRE, magnitude(y) + _CENTRE
        bound = exponent - log_threshold + _MARGIN + _MARGIN_FAR * (far_x * far_x * xx + far_y * far_y * yy)
        bound = bound * _WIDER
        for row in range(SIZE):
            dy = f32(row) - _CENTRE - y
            dx = minimum(maximum(ZERO - slope * dy, ZERO - _CENTRE - x), _CENTRE - x)
            va, vb = dx * ax + dy * ay, dx * bx + dy * by
            missed = bits_above(va * va + vb * vb, bound)
            strips[row * STRIPS // SIZE] |= (missed ^ ((1 << WIDTH) - 1)) << first
    for s in range(STRIPS):
        strips[s] &= (1 << n) - 1  # what lies behind them in memory


@inline
def alpha_of(layers, k, x, y, threshold):
    """Alpha of layer k at some pixels."""
    at = k * ROW
    dx = x - layers[at + 1]
    dy = y - layers[at + 2]
    va = dx * layers[at + 3] + dy * layers[at + 4]
    vb = dx * layers[at + 5] + dy * layers[at + 6]
    exponent = maximum(spread(layers[at]) - va * va - vb * vb, _FLOOR)
    alpha = minimum(exp2(exponent), _ALPHA_MAX)
    return where_at_least(alpha, threshold, alpha, ZERO)


@inline
def add_color(f, F, color, weight, layers, k):
    """The sum of feature f with that of layer k."""
    if f < F:
        color = color + weight * layers[k * ROW + 7 + f]
    return color


@inline
def keep_color(f, F, color, s, p):
    """Write the sum of feature f."""
    if f < F:
        store(s, (1 + f) * P + p, color)


@jit
def composite_forward(
    first_tile, grid, offsets, entries, table, threshold, stop, feature, channels, starts, strips, reached,
    transmittance, depths, sums,
):  # fmt: skip
    """A block of features: sums over layers, transmittance and median depth, straight into the images."""
    height, width = transmittance.shape[1], transmittance.shape[2]
    F, median = len(channels), len(depths) > 0
    pixels = scratch(2 * P)
    fill_pixels(pixels)
    log_threshold = f32(math.log2(threshold))
    found = np.empty(STRIPS, np.int64)
    s = scratch((2 + F) * P)  # T, sums, depth of the last layer before which T was at least one half
    layers = scratch(K * ROW)
    corner = scratch(ROW)  # what a row of the table is about
    corner[:] = ZERO
    last_column = table.shape[1] - 1
    keep = len(starts) > 0
    for t in range(len(reached)):
        camera, tile = (first_tile + t) // (grid[0] * grid[1]), (first_tile + t) % (grid[0] * grid[1])
        y0, x0 = tile // grid[1] * SIZE, tile % grid[1] * SIZE
        corner[1] = f32(x0) + _CENTRE
        corner[2] = f32(y0) + _CENTRE
        for p in range(P):  # pixels beyond the image are opaque
            s[p] = ONE if (x0 + p % SIZE < width and y0 + p // SIZE < height) else ZERO
        for p in range((F + 1) * P):
            s[P + p] = ZERO
        first, last = offsets[t], offsets[t + 1]
        chunk = first // K + t
        e = first
        while e < last:
            if total(load(s, 0) + load(s, WIDTH) + load(s, 2 * WIDTH) + load(s, 3 * WIDTH)) == ZERO:
                break
            if keep:
                for p in range(P):
                    starts[chunk, p] = s[p]
            n = min(K, last - e)
            gather(table, entries, e, n, corner, feature, F, layers)
            find_strips(layers, n, log_threshold, found)
            if keep:
                for i in range(STRIPS):
                    strips[chunk, i] = found[i]
            chunk += 1
            for p in range(0, P, WIDTH):
                x = load(pixels, p)
                y = load(pixels, P + p)
                before = load(s, p)
                depth = load(s, (1 + F) * P + p)
                # a name for each feature, because an array would be memory; what lies beyond F is compiled to nothing
                c0 = load(s, (1 + min(0, F)) * P + p)
                c1 = load(s, (1 + min(1, F)) * P + p)
                c2 = load(s, (1 + min(2, F)) * P + p)
                c3 = load(s, (1 + min(3, F)) * P + p)
                c4 = load(s, (1 + min(4, F)) * P + p)
                c5 = load(s, (1 + min(5, F)) * P + p)
                c6 = load(s, (1 + min(6, F)) * P + p)
                c7 = load(s, (1 + min(7, F)) * P + p)
                bits = (1 << n) - 1 if median else found[p // WIDTH]  # the median depth is that of any layer
                while bits != 0:
                    k = lowest(bits)
                    bits &= bits - 1
                    alpha = alpha_of(layers, k, x, y, threshold)
                    if median:
                        depth = where_at_least(before, HALF, table[entries[e + k], last_column], depth)
                    weight = alpha * where_at_least(before, stop, before, ZERO)
                    before = multiply_add(before, ZERO - alpha, before)
                    c0 = add_color(0, F, c0, weight, layers, k)
                    c1 = add_color(1, F, c1, weight, layers, k)
                    c2 = add_color(2, F, c2, weight, layers, k)
                    c3 = add_color(3, F, c3, weight, layers, k)
                    c4 = add_color(4, F, c4, weight, layers, k)
                    c5 = add_color(5, F, c5, weight, layers, k)
                    c6 = add_color(6, F, c6, weight, layers, k)
                    c7 = add_color(7, F, c7, weight, layers, k)
                store(s, p, where_at_least(before, stop, before, ZERO))
                keep_color(0, F, c0, s, p)
                keep_color(1, F, c1, s, p)
                keep_color(2, F, c2, s, p)
                keep_color(3, F, c3, s, p)
                keep_color(4, F, c4, s, p)
                keep_color(5, F, c5, s, p)
                keep_color(6, F, c6, s, p)
                keep_color(7, F, c7, s, p)
                store(s, (1 + F) * P + p, depth)
            e += n
        reached[t] = e - first
        for y in range(min(SIZE, height - y0)):
            for x in range(min(SIZE, width - x0)):
                left = transmittance[camera, y0 + y, x0 + x] = s[y * SIZE + x]
                if median:
                    depths[camera, y0 + y, x0 + x] = s[(1 + F) * P + y * SIZE + x] if left < HALF else ZERO
                for f in range(min(F, sums.shape[1] - feature)):
                    sums[camera, feature + f, y0 + y, x0 + x] = s[(1 + f) * P + y * SIZE + x]


@jit
def composite_backward(
    first_tile, grid, offsets, entries, table, threshold, stop, feature, channels, starts, strips, reached,
    grads, grad_transmittance, needs_absolute, sums,
):  # fmt: skip
    """For each member the six moments of dL/d ln alpha about its centre, and dL/d features, added to `sums`.

    The sums of |dL/d mean| are computed where they are needed. `starts`, `strips` and `reached` are as
    `composite_forward` left them; `grad_transmittance` is used with the first block.
    """
    height, width = grad_transmittance.shape[1], grad_transmittance.shape[2]
    F = len(channels)
    pixels = scratch(2 * P)
    fill_pixels(pixels)
    g = scratch(F * P)
    behind = scratch(P)  # V behind the layers that are still to come
    layers = scratch(K * ROW)
    corner = scratch(ROW)  # what a row of the table is about
    corner[:] = ZERO
    alphas = scratch(K * P)  # of each layer of a chunk, later dL/d ln alpha
    weights = scratch(K * P)  # at first T before each layer
    for t in range(len(reached)):
        count = reached[t]
        if count == 0:
            continue
        camera, tile = (first_tile + t) // (grid[0] * grid[1]), (first_tile + t) % (grid[0] * grid[1])
        y0, x0 = tile // grid[1] * SIZE, tile % grid[1] * SIZE
        corner[1] = f32(x0) + _CENTRE
        corner[2] = f32(y0) + _CENTRE
        for p in range(P):
            behind[p] = ZERO
        for p in range(F * P):
            g[p] = ZERO
        for row in range(min(SIZE, height - y0)):
            for column in range(min(SIZE, width - x0)):
                if feature == 0:
                    behind[row * SIZE + column] = grad_transmittance[camera, y0 + row, x0 + column]
                for f in range(min(F, grads.shape[1] - feature)):
                    g[f * P + row * SIZE + column] = grads[camera, feature + f, y0 + row, x0 + column]
        for chunk in range((count - 1) // K, -1, -1):
            base = offsets[t] + chunk * K
            n = min(K, count - chunk * K)
            gather(table, entries, base, n, corner, feature, F, layers)
            start = starts[offsets[t] // K + t + chunk]
            found = strips[offsets[t] // K + t + chunk]
            for p in range(0, P, WIDTH):
                x = load(pixels, p)
                y = load(pixels, P + p)
                before = load(start, p)
                bits = ((1 << n) - 1) ^ found[p // WIDTH]
                while bits != 0:
                    k = lowest(bits)
                    bits &= bits - 1
                    store(alphas, k * P + p, spread(ZERO))
                    store(weights, k * P + p, spread(ZERO))
                bits = found[p // WIDTH]
                while bits != 0:
                    k = lowest(bits)
                    bits &= bits - 1
                    alpha = alpha_of(layers, k, x, y, threshold)
                    store(alphas, k * P + p, alpha)
                    store(weights, k * P + p, before)
                    before = multiply_add(before, ZERO - alpha, before)
                left = before
                v = load(behind, p)
                bits = found[p // WIDTH]
                while bits != 0:
                    k = highest(bits)
                    bits ^= 1 << k
                    value = load(g, p) * layers[k * ROW + 7]
                    for f in range(1, F):
                        value = value + load(g, f * P + p) * layers[k * ROW + 7 + f]
                    alpha = load(alphas, k * P + p)
                    before = load(weights, k * P + p)
                    weight = alpha * where_at_least(before, stop, before, ZERO)
                    step = value - where_at_least(left, stop, v, ZERO)
                    v = multiply_add(v, where_at_least(left, stop, ONE - alpha, ZERO), alpha * value)
                    store(alphas, k * P + p, where_above(_ALPHA_MAX, alpha, weight * step, ZERO))
                    store(weights, k * P + p, weight)
                    left = before
                store(behind, p, v)
            for k in range(n):
                add_layer(k, F, needs_absolute, pixels, layers, alphas, weights, g, sums[entries[base + k]])


@inline
def add_layer(k, F, needs_absolute, pixels, layers, derivatives, weights, g, row):
    """Add to `row`, `(ROW,)`, what layer k of a chunk gets from a tile; derivatives are dL/d ln alpha."""
    at = k * ROW
    dx = load(pixels, 0) - layers[at + 1]  # the same in each row
    m = spread(ZERO)
    my = spread(ZERO)
    myy = spread(ZERO)
    for p in range(0, P, WIDTH):
        d = load(derivatives, k * P + p)
        dy = load(pixels, P + p) - layers[at + 2]
        m = m + d
        my = my + d * dy
        myy = myy + d * dy * dy
    across = spread(ZERO)
    up = spread(ZERO)
    if needs_absolute:
        for p in range(0, P, WIDTH):
            d = load(derivatives, k * P + p)
            dy = load(pixels, P + p) - layers[at + 2]
            va = dx * layers[at + 3] + dy * layers[at + 4]
            vb = dx * layers[at + 5] + dy * layers[at + 6]
            across = across + magnitude(d * (va * layers[at + 3] + vb * layers[at + 5]))
            up = up + magnitude(d * (va * layers[at + 4] + vb * layers[at + 6]))
    c0 = color_sum(0, F, k, weights, g)
    c1 = color_sum(1, F, k, weights, g)
    c2 = color_sum(2, F, k, weights, g)
    c3 = color_sum(3, F, k, weights, g)
    c4 = color_sum(4, F, k, weights, g)
    c5 = color_sum(5, F, k, weights, g)
    c6 = color_sum(6, F, k, weights, g)
    c7 = color_sum(7, F, k, weights, g)
    moments = (m, m * dx, my, m * dx * dx, my * dx, myy)
    gained = totals((*moments, c0, c1, c2, c3, c4, c5, c6, c7, across * TWICE_LN2, up * TWICE_LN2))
    store(row, 0, load(row, 0) + gained)


@inline
def color_sum(f, F, k, weights, g):
    """The sum of weight times dL/d image of feature f, in lanes."""
    result = spread(ZERO)
    if f < F:
        for p in range(0, P, WIDTH):
            result = result + load(weights, k * P + p) * load(g, f * P + p)
    return result


@jit
def add_members(begin, end, offsets, members, sums, totals):
    """Add what the members got to `totals` of the Gaussians `begin` to `end`, one band after the other."""
    for band in range(len(offsets) - 1):
        own = members[offsets[band] : offsets[band + 1]]
        for m in range(offsets[band] + np.searchsorted(own, begin), offsets[band + 1]):
            i = members[m]
            if i >= end:
                break
            for b in range(len(sums)):
                for j in range(ROW):
                    totals[i, b * ROW + j] += sums[b, m, j]


@jit
def fill_gradients(
    begin, end, ranks, totals, factors, opacities, eps2d, d_means2d, d_factors, d_opacities, d_features, d_absolute,
):  # fmt: skip
    """From moments to gradients, see `kgs.geometry.covariance.moment_gradients`; what is not wanted is empty."""
    F = d_features.shape[1] if len(d_features) else 0
    needs_moments = len(d_opacities) > 0
    needs_absolute = len(d_absolute) > 0
    gathered = np.empty((_BLOCK, totals.shape[1]), np.float32)
    for block in range(begin, end, _BLOCK):
        stop = min(block + _BLOCK, end)
        for g in range(block, stop):  # reads that miss the caches, many under way at a time
            for j in range(totals.shape[1]):
                gathered[g - block, j] = totals[ranks[g], j] if ranks[g] >= 0 else ZERO
        for g in range(block, stop):
            total = gathered[g - block]
            for f in range(F):
                d_features[g, f] = total[f // FEATURES * ROW + MOMENTS + f % FEATURES]
            for b in range(ROW, totals.shape[1], ROW):  # V is linear in the features
                for j in range(MOMENTS):
                    total[j] += total[b + j]
                for j in range(ABSOLUTE, ROW):
                    total[j] += total[b + j]
            if needs_absolute:
                d_absolute[g, 0] = total[ABSOLUTE]
                d_absolute[g, 1] = total[ABSOLUTE + 1]
            if not needs_moments:
                continue
            a0, a1, a2 = factors[g, 0, 0], factors[g, 0, 1], factors[g, 0, 2]
            b0, b1, b2 = factors[g, 1, 0], factors[g, 1, 1], factors[g, 1, 2]
            xx, xy, yy, det = variances(a0, a1, a2, b0, b1, b2, eps2d)
            d_opacities[g] = total[0] / opacities[g] if ranks[g] >= 0 else ZERO
            if ranks[g] < 0 or not is_finite(det):  # in no list, or it overflows: flat over the image
                d_means2d[g, 0] = d_means2d[g, 1] = ZERO
                d_factors[g] = ZERO
                continue
            r = ONE / det
            d_means2d[g, 0] = (yy * total[1] - xy * total[2]) * r
            d_means2d[g, 1] = (xx * total[2] - xy * total[1]) * r
            u, v, w = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
            # det Q M without cancellation: rows e a + b x w and e b + w x a
            p = eps2d * a0 + b1 * w - b2 * v, eps2d * a1 + b2 * u - b0 * w, eps2d * a2 + b0 * v - b1 * u
            q = eps2d * b0 + v * a2 - w * a1, eps2d * b1 + w * a0 - u * a2, eps2d * b2 + u * a1 - v * a0
            for c in range(3):
                x, y = p[c] * r, q[c] * r
                m, n = total[3] * x + total[4] * y, total[4] * x + total[5] * y
                d_factors[g, 0, c] = (yy * m - xy * n) * r
                d_factors[g, 1, c] = (xx * n - xy * m) * r
