"""Costs of a plane sweep, by the formulas of `kgs.init_points.sweep_costs`; planes come last, they are the SIMD lanes.

    image, mean, variance   (H, W), the latter two over the window around a pixel
    warped                  (P, 2, H, W), another view's image warped by P planes of the sweep, and its mask of ones
    prices                  float32: of a step by one plane; of a jump without an edge, times the next; the difference
                            of grey values that halves the price of a jump; the least price of a jump
    best, second            (H, W, D), the two highest scores of a pixel at a plane so far
    cost, total             (H, W, D), the costs of planes, and the sum of the costs of paths

Sums over windows are in float64, and all else rounds as written: results differ from torch's in a few last bits.
"""

import numpy as np

from kgs.compiled.kernel import ONE, ZERO, exact, f32, inline
from kgs.compiled.threads import over

HALO = 3  # pixels of a window on each side of its centre
BAND = 16  # rows that one task computes
PATHS = 8  # that one task follows side by side
LANES = 16  # the number of planes is padded to a multiple of this
INFINITY = f32(np.inf)
DIRECTIONS = [(dy, dx) for dy in (1, -1) for dx in (-1, 0, 1)] + [(0, 1), (0, -1)]  # rows and columns of a step


def add_scores(threads, image, mean, variance, flat, warped, plane, best, second):
    """Enter the scores of planes `plane`, `plane + 1`, ... into `best` and `second`; `flat` is added to variances."""
    bands = -(-image.shape[0] // BAND)
    over(threads, bands, enter_scores, image, mean, variance, flat, warped, plane, best, second, pieces=bands)


def semi_global(threads, cost, grey, prices, total):
    """Sum the costs of the cheapest paths along eight directions into `total`."""
    total[:] = ZERO
    for dy, dx in DIRECTIONS:
        groups = -(-(cost.shape[1] if dy else cost.shape[0]) // PATHS)
        over(threads, groups, add_paths, cost, grey, dy, dx, prices, total, pieces=groups)


@inline
def row_sum(a, x):
    """a[x] + ... + a[x + 6]."""
    return a[x] + a[x + 1] + a[x + 2] + a[x + 3] + a[x + 4] + a[x + 5] + a[x + 6]


@exact
def enter_scores(begin, end, image, mean, variance, flat, warped, plane, best, second):
    """Normalised cross-correlation of windows, in bands of rows; 0 where a window leaves the other image."""
    height, width = image.shape
    planes = warped.shape[0]
    sums = np.empty((planes, 4, width + 2 * HALO))  # of columns: warped, its square, its product with the image, inside
    scores = np.empty((planes, width), np.float32)
    share = 1.0 / (2 * HALO + 1) ** 2
    for band in range(begin, end):
        sums[:] = 0.0
        for y in range(band * BAND - 2 * HALO - 1, min((band + 1) * BAND, height)):
            # The row that enters the window below and, once the window is full, the one that leaves it above.
            below = min(max(y + HALO, 0), height - 1)
            above = min(max(y - HALO - 1, 0), height - 1)
            is_full = 1.0 if y >= band * BAND else 0.0
            for p in range(planes):
                s0, s1, s2, s3 = sums[p, 0], sums[p, 1], sums[p, 2], sums[p, 3]
                for x in range(width):
                    s0[HALO + x] += np.float64(warped[p, 0, below, x]) - is_full * np.float64(warped[p, 0, above, x])
                    s3[HALO + x] += np.float64(warped[p, 1, below, x]) - is_full * np.float64(warped[p, 1, above, x])
                for x in range(width):
                    new, old = warped[p, 0, below, x], warped[p, 0, above, x]
                    s1[HALO + x] += np.float64(new * new) - is_full * np.float64(old * old)
                    s2[HALO + x] += np.float64(image[below, x] * new) - is_full * np.float64(image[above, x] * old)
                if y < band * BAND:
                    continue
                for x in range(HALO):
                    for s in range(4):  # the border is replicated
                        sums[p, s, x] = sums[p, s, HALO]
                        sums[p, s, HALO + width + x] = sums[p, s, HALO + width - 1]
                for x in range(width):
                    warped_mean = f32(row_sum(s0, x) * share)
                    product = f32(row_sum(s2, x) * share)
                    spread = f32(row_sum(s1, x) * share) - warped_mean * warped_mean
                    spread = spread if spread > ZERO else ZERO
                    inverse_deviation = ONE / np.sqrt((variance[y, x] + flat) * (spread + flat))
                    score = (product - mean[y, x] * warped_mean) * inverse_deviation
                    scores[p, x] = score if f32(row_sum(s3, x) * share) > f32(0.99) else ZERO
            if y >= band * BAND:
                for x in range(width):
                    for p in range(planes):
                        score = scores[p, x]
                        first = best[y, x, plane + p]
                        other = second[y, x, plane + p]
                        lower = score if score < first else first
                        best[y, x, plane + p] = first if score < first else score
                        second[y, x, plane + p] = lower if lower > other else other


@exact
def add_paths(begin, end, cost, grey, dy, dx, prices, total):
    """Add the costs of the cheapest paths in one direction, `PATHS` of them at a time; they wrap around at the sides.

    A path continues that of the same plane, of one beside it for a price, or of any for another, lower at edges.
    """
    height, width, planes = cost.shape
    step, jump, edge, least_jump = prices
    size = (planes + LANES - 1) // LANES * LANES
    memory = np.full((2, PATHS, size + 2), INFINITY)  # costs of the paths so far, between infinite ones
    lowest = np.empty(PATHS, np.float32)  # of each path
    lanes = np.empty(LANES, np.float32)
    length, across = (height, width) if dy else (width, height)
    for group in range(begin, end):
        for i in range(length):
            before, after = memory[i % 2], memory[(i + 1) % 2]
            for k in range(min(PATHS, across - group * PATHS)):
                if dy:
                    y, x = (i if dy > 0 else height - 1 - i), (group * PATHS + k + dx * i) % width
                else:
                    y, x = group * PATHS + k, (i if dx > 0 else width - 1 - i)
                previous = before[k]
                path = after[k]
                here = cost[y, x]
                out = total[y, x]
                if i == 0 or not 0 <= x - dx < width:
                    for d in range(planes):
                        path[1 + d] = here[d]
                else:
                    slope = abs(grey[y, x] - grey[y - dy, x - dx])
                    least = lowest[k]
                    price = ONE / (edge + slope) * jump
                    anywhere = least + (price if price > least_jump else least_jump)
                    for d in range(planes):
                        cheapest = previous[1 + d] if previous[1 + d] < anywhere else anywhere
                        left, right = previous[d] + step, previous[2 + d] + step
                        cheapest = left if left < cheapest else cheapest
                        cheapest = right if right < cheapest else cheapest
                        path[1 + d] = here[d] + (cheapest - least)
                lanes[:] = INFINITY
                for d in range(0, size, LANES):
                    for lane in range(LANES):
                        value = path[1 + d + lane]
                        lanes[lane] = value if value < lanes[lane] else lanes[lane]
                lowest[k] = lanes.min()
                for d in range(planes):
                    out[d] += path[1 + d]
