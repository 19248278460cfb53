"""L1 + w (1 - SSIM) and its gradient, by the formulas of `kgs.losses.photometric`, in bands of rows that stay in cache.

All is float32 but the sums. Arrays of the kernels, K the channels of all pictures, one after another, H, W >= 11:

    image, target, mean_y, variance_y   (K, H, W), the latter two local moments of the target
    taps                                the first six of the window, as the target's moments were made with, to the bit
    maps                                (3, K, H, W), derivatives of the SSIM by local mean, square and product
    sums                                (bands, 2) float64, of the absolute difference and of the SSIM
    padded                              (K, H + 10, W), derivatives by the pixels, rows of the border still unfolded
    grad                                (K, H, W)

Ranges are of bands of rows, or of rows, of all channels.
"""

import numpy as np

from kgs._support.compiled.kernel import ONE, TWO, ZERO, f32, inline, jit, scratch

RADIUS, BAND = 5, 32  # of the window; rows of a band
C1, C2, EPS = f32(0.01**2), f32(0.03**2), f32(1e-12)


@inline
def across(taps, a, x):
    """Weighted sum of a[x] ... a[x + 10]."""
    outer = taps[0] * (a[x] + a[x + 10]) + taps[1] * (a[x + 1] + a[x + 9]) + taps[2] * (a[x + 2] + a[x + 8])
    return outer + taps[3] * (a[x + 3] + a[x + 7]) + taps[4] * (a[x + 4] + a[x + 6]) + taps[5] * a[x + 5]


@inline
def down(taps, a, r, x):
    """Weighted sum of a[r, x] ... a[r + 10, x]."""
    outer = (
        taps[0] * (a[r, x] + a[r + 10, x])
        + taps[1] * (a[r + 1, x] + a[r + 9, x])
        + taps[2] * (a[r + 2, x] + a[r + 8, x])
    )
    return outer + taps[3] * (a[r + 3, x] + a[r + 7, x]) + taps[4] * (a[r + 4, x] + a[r + 6, x]) + taps[5] * a[r + 5, x]


@inline
def padded_row(image, c, y, row):
    """Row y of an image with reflected border, y and x from -5."""
    height, width = image.shape[1], image.shape[2]
    y = abs(y)
    y = y if y < height else 2 * height - 2 - y
    for x in range(width):
        row[RADIUS + x] = image[c, y, x]
    for x in range(1, RADIUS + 1):
        row[RADIUS - x] = image[c, y, x]
        row[RADIUS + width - 1 + x] = image[c, y, width - 1 - x]


@jit
def fill_moments(begin, end, taps, target, mean_y, variance_y):
    """Mean and variance of the target under the window around each pixel, from differences to a pixel of the band."""
    height, width = target.shape[1], target.shape[2]
    per_channel = (height + BAND - 1) // BAND
    row, squares = scratch(width + 10), scratch(width + 10)
    h = np.empty((2, BAND + 10, width), np.float32)
    h0, h1 = h[0], h[1]
    for u in range(begin, end):
        c, top = u // per_channel, u % per_channel * BAND
        n = min(BAND, height - top)
        pivot = target[c, top, 0]
        for r in range(n + 10):
            padded_row(target, c, top + r - RADIUS, row)
            for x in range(width + 10):
                row[x] -= pivot
                squares[x] = row[x] * row[x]
            for x in range(width):
                h0[r, x] = across(taps, row, x)
            for x in range(width):
                h1[r, x] = across(taps, squares, x)
        for r in range(n):
            for x in range(width):
                mean = down(taps, h0, r, x)
                mean_y[c, top + r, x] = pivot + mean
                variance_y[c, top + r, x] = down(taps, h1, r, x) - mean * mean


@jit
def ssim_maps(begin, end, taps, image, target, mean_y, variance_y, maps, sums):
    """Derivatives of the SSIM; sums of both terms of the loss."""
    height, width = image.shape[1], image.shape[2]
    per_channel = (height + BAND - 1) // BAND
    x_row, y_row, xx_row, xy_row = scratch(width + 10), scratch(width + 10), scratch(width + 10), scratch(width + 10)
    h = np.empty((3, BAND + 10, width), np.float32)
    h0, h1, h2 = h[0], h[1], h[2]
    for u in range(begin, end):
        c, top = u // per_channel, u % per_channel * BAND
        n = min(BAND, height - top)
        for r in range(n + 10):
            padded_row(image, c, top + r - RADIUS, x_row)
            padded_row(target, c, top + r - RADIUS, y_row)
            for x in range(width + 10):
                xx_row[x] = x_row[x] * x_row[x]
                xy_row[x] = x_row[x] * y_row[x]
            for x in range(width):
                h0[r, x] = across(taps, x_row, x)
            for x in range(width):
                h1[r, x] = across(taps, xx_row, x)
            for x in range(width):
                h2[r, x] = across(taps, xy_row, x)
            if RADIUS <= r < n + RADIUS:
                part = ZERO
                for x in range(width):
                    part += abs(x_row[RADIUS + x] - y_row[RADIUS + x])
                sums[u, 0] += part
        for r in range(n):
            y, part = top + r, ZERO
            for x in range(width):
                mean, my = down(taps, h0, r, x), mean_y[c, y, x]
                squared, product = mean * mean, mean * my
                b = TWO * (down(taps, h2, r, x) - product) + C2
                d = down(taps, h1, r, x) - squared + variance_y[c, y, x] + C2
                a, e = TWO * product + C1, squared + my * my + C1
                inverse = ONE / (e * d + EPS)
                s = a * b * inverse
                part += s
                scaled = s * inverse
                by_square = -e * scaled
                maps[0, c, y, x] = TWO * ((b - a) * inverse * my - (d * scaled + by_square) * mean)
                maps[1, c, y, x] = by_square
                maps[2, c, y, x] = TWO * a * inverse
            sums[u, 1] += part


@jit
def ssim_gradient(begin, end, taps, image, target, maps, padded):
    """Adjoint of the window on the three maps, times what they multiply; columns of the border folded back."""
    height, width = image.shape[1], image.shape[2]
    per_channel = (height + 10 + BAND - 1) // BAND
    x_row, y_row, total = scratch(width + 10), scratch(width + 10), scratch(width + 10)
    row, v = scratch(width + 20), np.zeros((BAND + 10, width + 20), np.float32)
    out = np.empty((3, BAND, width + 10), np.float32)
    for u in range(begin, end):
        c, top = u // per_channel, u % per_channel * BAND
        n = min(BAND, height + 10 - top)
        for m in range(3):
            for r in range(n + 10):
                y = top + r - 10
                if 0 <= y < height:
                    for x in range(width):
                        v[r, 10 + x] = maps[m, c, y, x]
                else:
                    for x in range(width):
                        v[r, 10 + x] = ZERO
            for r in range(n):
                for x in range(width + 20):
                    row[x] = down(taps, v, r, x)
                for x in range(width + 10):
                    out[m, r, x] = across(taps, row, x)
        for r in range(n):
            y = top + r
            padded_row(image, c, y - RADIUS, x_row)
            padded_row(target, c, y - RADIUS, y_row)
            for x in range(width + 10):
                total[x] = out[0, r, x] + TWO * x_row[x] * out[1, r, x] + y_row[x] * out[2, r, x]
            for x in range(1, RADIUS + 1):
                total[RADIUS + x] += total[RADIUS - x]
                total[RADIUS + width - 1 - x] += total[RADIUS + width - 1 + x]
            for x in range(width):
                padded[c, y, x] = total[RADIUS + x]


@jit
def total_gradient(begin, end, image, target, padded, by_ssim, by_l1, grad):
    """Fold the rows of the border back, scale, and add the gradient of the absolute difference."""
    height, width = image.shape[1], image.shape[2]
    for u in range(begin, end):
        c, y = u // height, u % height
        above = RADIUS - y if 1 <= y <= RADIUS else RADIUS + y
        mirror = 2 * (height - 1) - y
        below = RADIUS + mirror if height - 1 - RADIUS <= y < height - 1 else RADIUS + y
        first, second = ONE if above != RADIUS + y else ZERO, ONE if below != RADIUS + y else ZERO
        for x in range(width):
            d = image[c, y, x] - target[c, y, x]
            sign = (ONE if d > ZERO else ZERO) - (ONE if d < ZERO else ZERO)
            total = padded[c, RADIUS + y, x] + first * padded[c, above, x] + second * padded[c, below, x]
            grad[c, y, x] = by_ssim * total + by_l1 * sign
