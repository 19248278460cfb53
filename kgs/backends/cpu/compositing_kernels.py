"""Front-to-back compositing of the lists of a band, and its gradient; formulas as in `kgs.backends.torch`.

A tile is P pixels, the lanes. T is kept at the beginning of every chunk of K entries; the backward pass goes from chunk
to chunk, back to front, and computes alphas and T of each again, with the same bits. Features come in blocks that a
kernel is compiled for: V is linear in the features and in dL/dT, so blocks are differentiated one after the other, and
their moments are added.

What the kernels take, for C cameras, T tiles of a band and blocks of F features:

    first_tile, offsets, entries, table   those of the `Band`
    grid                                  (rows, columns) of tiles of one image
    threshold, stop                       smaller alphas count as 0, and so does a smaller transmittance
    feature                               where the block of features begins
    channels                              any tuple of as many numbers as the block has features
    starts                                (chunks, P), T at the beginning of each chunk; or empty
    reached                               (T,), how many entries of each tile were composited
    transmittance, depths                 (C, H, W), the latter the median depth; or empty
    sums                                  (C, features, H, W); in the backward pass (members, 6 + features)
    grads, grad_transmittance             (C, features, H, W) and (C, H, W), derivatives of the loss
"""

import numpy as np

from kgs.compiled.kernel import HALF, ONE, ZERO, exp2, f32, inline, is_finite, jit, scratch

from .binning_kernels import SIZE, variances

P = SIZE * SIZE
K = 16
WIDTHS = (3, 4, 8)  # of blocks of features
TINY = 2.0**-125  # smaller alphas and T are 0: products with them would be denormal, and slow
_ALPHA_MAX = f32(0.99)
_FLOOR = f32(-126.0)  # of the exponent to base 2: below it floats are denormal
_CENTRE = f32(0.5 * (SIZE - 1))
_SLAB = 4 * P
TWICE_LN2 = f32(1.3862943611198906)  # of the derivative of the exponent to base 2, by the whitening vectors
_BLOCK = 64


@inline
def place_pixels(pixels):
    """X and y of the pixels of a tile about its centre, `(2 P,)`."""
    for p in range(P):
        pixels[p] = f32(p % SIZE) - _CENTRE
        pixels[P + p] = f32(p // SIZE) - _CENTRE


@inline
def gather(table, entries, first, n, feature, channels, layers):
    """Copy what a chunk needs: reads that miss the caches, many under way at a time."""
    for k in range(n):
        i = entries[first + k]
        for j in range(7):
            layers[k, j] = table[i, j]
        for f in range(channels):
            layers[k, 7 + f] = table[i, 7 + feature + f]


@inline
def alpha_of(o, ax, ay, bx, by, dx, dy, threshold):
    """Alpha of a layer at a pixel."""
    va, vb = ax * dx + ay * dy, bx * dx + by * dy
    a = min(exp2(max(o - va * va - vb * vb, _FLOOR)), _ALPHA_MAX)
    return a if a >= threshold else ZERO


@jit
def composite_forward(
    first_tile, grid, offsets, entries, table, threshold, stop, feature, channels, starts, reached,
    transmittance, depths, sums,
):  # fmt: skip
    """A block of features: sums over layers, transmittance and median depth, straight into the images."""
    height, width = transmittance.shape[1], transmittance.shape[2]
    F, median = len(channels), len(depths) > 0
    pixels = scratch(2 * P)
    place_pixels(pixels)
    s = scratch((3 + F) * P)  # T, w, sums, depth of the last layer before which T was at least one half
    layers = np.empty((K, 7 + F), np.float32)
    last_column = table.shape[1] - 1
    keep = len(starts) > 0
    for t in range(len(reached)):
        camera, tile = (first_tile + t) // (grid[0] * grid[1]), (first_tile + t) % (grid[0] * grid[1])
        y0, x0 = tile // grid[1] * SIZE, tile % grid[1] * SIZE
        cx, cy = f32(x0) + _CENTRE, f32(y0) + _CENTRE
        for p in range(P):  # pixels beyond the image are opaque
            s[p] = ONE if (x0 + p % SIZE < width and y0 + p // SIZE < height) else ZERO
        for p in range((F + 1) * P):
            s[2 * P + p] = ZERO
        first, last = offsets[t], offsets[t + 1]
        chunk = first // K + t
        e = first
        while e < last:
            most = ZERO
            for p in range(P):
                most = max(most, s[p])
            if most == ZERO:
                break
            if keep:
                for p in range(P):
                    starts[chunk, p] = s[p]
                chunk += 1
            n = min(K, last - e)
            gather(table, entries, e, n, feature, F, layers)
            for k in range(n):
                o, ux, uy = layers[k, 0], layers[k, 1] - cx, layers[k, 2] - cy
                ax, ay, bx, by = layers[k, 3], layers[k, 4], layers[k, 5], layers[k, 6]
                if median:
                    depth = table[entries[e + k], last_column]
                    for p in range(P):
                        s[(2 + F) * P + p] = depth if s[p] >= HALF else s[(2 + F) * P + p]
                for p in range(P):
                    a = alpha_of(o, ax, ay, bx, by, pixels[p] - ux, pixels[P + p] - uy, threshold)
                    w = a * s[p]
                    left = s[p] - w
                    left = left if left >= stop else ZERO
                    s[P + p] = w
                    s[p] = left
                for f in range(F):
                    c = layers[k, 7 + f]
                    for p in range(P):
                        s[(2 + f) * P + p] += c * s[P + p]
            e += n
        reached[t] = e - first
        for y in range(min(SIZE, height - y0)):
            for x in range(min(SIZE, width - x0)):
                left = transmittance[camera, y0 + y, x0 + x] = s[y * SIZE + x]
                if median:
                    depths[camera, y0 + y, x0 + x] = s[(2 + F) * P + y * SIZE + x] if left < HALF else ZERO
                for f in range(min(F, sums.shape[1] - feature)):
                    sums[camera, feature + f, y0 + y, x0 + x] = s[(2 + f) * P + y * SIZE + x]


@jit
def composite_backward(
    first_tile, grid, offsets, entries, table, threshold, stop, feature, channels, starts, reached,
    grads, grad_transmittance,
    needs_moments, needs_absolute, needs_features, sums,
):  # fmt: skip
    """For each member the six moments of dL/d ln alpha about its centre, and dL/d features, added to `sums`.

    `sums` is `(members, 6 + F)`, and two columns wider where the sums of |dL/d mean| are needed, too. `starts` and
    `reached` are as `composite_forward` left them; `grad_transmittance` is used with the first block.
    """
    height, width = grad_transmittance.shape[1], grad_transmittance.shape[2]
    F = len(channels)
    pixels = scratch(2 * P)
    place_pixels(pixels)
    g = scratch(F * P)
    layers = np.empty((K, 7 + F), np.float32)
    s = scratch((K + 1) * _SLAB)  # of each layer of a chunk: alpha, w, T before it, V from this layer on
    for t in range(len(reached)):
        count = reached[t]
        if count == 0:
            continue
        camera, tile = (first_tile + t) // (grid[0] * grid[1]), (first_tile + t) % (grid[0] * grid[1])
        y0, x0 = tile // grid[1] * SIZE, tile % grid[1] * SIZE
        cx, cy = f32(x0) + _CENTRE, f32(y0) + _CENTRE
        for p in range(P):
            s[3 * P + p] = ZERO
        for p in range(F * P):
            g[p] = ZERO
        for y in range(min(SIZE, height - y0)):
            for x in range(min(SIZE, width - x0)):
                if feature == 0:
                    s[3 * P + y * SIZE + x] = grad_transmittance[camera, y0 + y, x0 + x]
                for f in range(min(F, grads.shape[1] - feature)):
                    g[f * P + y * SIZE + x] = grads[camera, feature + f, y0 + y, x0 + x]
        for chunk in range((count - 1) // K, -1, -1):
            base = offsets[t] + chunk * K
            n = min(K, count - chunk * K)
            for p in range(P):
                s[n * _SLAB + 3 * P + p] = s[3 * P + p]  # V behind this chunk
            for p in range(P):
                s[2 * P + p] = starts[offsets[t] // K + t + chunk, p]
            gather(table, entries, base, n, feature, F, layers)
            for k in range(n):
                b = k * _SLAB
                o, ux, uy = layers[k, 0], layers[k, 1] - cx, layers[k, 2] - cy
                ax, ay, bx, by = layers[k, 3], layers[k, 4], layers[k, 5], layers[k, 6]
                for p in range(P):
                    a = alpha_of(o, ax, ay, bx, by, pixels[p] - ux, pixels[P + p] - uy, threshold)
                    w = a * s[b + 2 * P + p]
                    left = s[b + 2 * P + p] - w
                    s[b + p] = a
                    s[b + P + p] = w
                    s[b + _SLAB + 2 * P + p] = left if left >= stop else ZERO
            for k in range(n - 1, -1, -1):
                i = entries[base + k]
                b = (k * _SLAB) & 0x7FFFFFFF  # so that the compiler knows it is not negative: indices wrap
                if needs_moments:
                    ux, uy = layers[k, 1] - cx, layers[k, 2] - cy
                    m0 = mx = my = mxx = mxy = myy = ZERO
                    for p in range(P):
                        value = ZERO
                        for f in range(F):
                            value += layers[k, 7 + f] * g[f * P + p]
                        a, w = s[b + p], s[b + P + p]
                        later = s[b + _SLAB + 3 * P + p] if s[b + _SLAB + 2 * P + p] > ZERO else ZERO
                        step = value - later
                        s[b + 3 * P + p] = later + a * step
                        d = w * step if a < _ALPHA_MAX else ZERO
                        dx, dy = pixels[p] - ux, pixels[P + p] - uy
                        m0 += d
                        mx += d * dx
                        my += d * dy
                        mxx += d * dx * dx
                        mxy += d * dx * dy
                        myy += d * dy * dy
                        s[b + p] = d
                    sums[i, 0] += m0
                    sums[i, 1] += mx
                    sums[i, 2] += my
                    sums[i, 3] += mxx
                    sums[i, 4] += mxy
                    sums[i, 5] += myy
                if needs_absolute:
                    ax, ay, bx, by = layers[k, 3], layers[k, 4], layers[k, 5], layers[k, 6]
                    ux, uy = layers[k, 1] - cx, layers[k, 2] - cy
                    left_right = up_down = ZERO
                    for p in range(P):
                        dx, dy = pixels[p] - ux, pixels[P + p] - uy
                        va, vb = ax * dx + ay * dy, bx * dx + by * dy
                        left_right += abs(s[b + p] * (va * ax + vb * bx))
                        up_down += abs(s[b + p] * (va * ay + vb * by))
                    sums[i, sums.shape[1] - 2] += TWICE_LN2 * left_right
                    sums[i, sums.shape[1] - 1] += TWICE_LN2 * up_down
                if needs_features:
                    for f in range(F):
                        total = ZERO
                        for p in range(P):
                            total += s[b + P + p] * g[f * P + p]
                        sums[i, 6 + feature + f] += total


@jit
def add_members(begin, end, offsets, members, sums, totals):
    """Add what the members got to `totals` of the Gaussians `begin` to `end`, one band after the other."""
    for band in range(len(offsets) - 1):
        own = members[offsets[band] : offsets[band + 1]]
        for m in range(offsets[band] + np.searchsorted(own, begin), offsets[band + 1]):
            i = members[m]
            if i >= end:
                break
            for j in range(totals.shape[1]):
                totals[i, j] += sums[m, j]


@jit
def fill_gradients(
    begin, end, ranks, totals, factors, opacities, eps2d, d_means2d, d_factors, d_opacities, d_features
):  # fmt: skip
    """From moments to gradients, see `kgs.covariance.moment_gradients`; what is not wanted is empty."""
    F = d_features.shape[1] if len(d_features) else 0
    needs_moments = len(d_opacities) > 0
    gathered = np.empty((_BLOCK, 6 + F), np.float32)
    for block in range(begin, end, _BLOCK):
        stop = min(block + _BLOCK, end)
        for g in range(block, stop):  # reads that miss the caches, many under way at a time
            for j in range(6 + F):
                gathered[g - block, j] = totals[ranks[g], j] if ranks[g] >= 0 else ZERO
        for g in range(block, stop):
            total = gathered[g - block]
            for f in range(F):
                d_features[g, f] = total[6 + f]
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
