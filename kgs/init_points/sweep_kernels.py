"""Costs of a plane sweep, by the formulas of `kgs.init_points.sweep_costs`; planes come last, they are the SIMD lanes.

    image                   (H + 6, W + 6), its border replicated, minus the mean grey value
    mean, variance          (H, W), of that image over the window around a pixel; the mean is float64
    others                  (N, H + 1, W + 1), the neighbours' images minus the same value; the last row and column
                            have no weight
    constants               float32: added to variances; the score of a plane on which no neighbour shows the window;
                            the second best score where one neighbour shows it, over that one's
    homographies            (N, D, 3, 3) float64, from pixels of the image to those of a neighbour
    prices                  float32: of a step by one plane; of a jump without an edge, times the next; the difference
                            of grey values that halves the price of a jump; the least price of a jump
    cost, total             (H, W, D), the costs of planes, and the sum of the costs of paths

Sums over windows are in float64: of a window with little contrast, float32 would lose most of the variance. All rounds
as written, so that the bits depend neither on threads nor on the processor.
"""

import numpy as np

from kgs._support.compiled.kernel import ONE, ZERO, exact, f32, inline
from kgs._support.compiled.threads import parallel_for

HALO = 3  # pixels of a window on each side of its centre
SIDE = 2 * HALO + 1
TILE_ROWS, TILE_COLUMNS = 32, 128  # pixels that one task compares: what it works on stays in the cache
PATHS = 8  # that one task follows side by side
LANES = 16  # planes that are compared at a time, and of which the paths' memory holds a multiple
MARGIN = 1e-3  # pixels by which a point may lie outside an image: rounding of the homography
INFINITY = f32(np.inf)
DIRECTIONS = [(dy, dx) for dy in (1, -1) for dx in (-1, 0, 1)] + [(0, 1), (0, -1)]  # rows and columns of a step


def compare(threads, image, mean, variance, constants, others, homographies, cost):
    """Write 1 minus the scores of all planes to `cost`."""
    height, width = mean.shape
    tiles = -(-height // TILE_ROWS) * -(-width // TILE_COLUMNS)
    parallel_for(
        threads, tiles, compare_tiles, image, mean, variance, constants, others, homographies, cost, pieces=tiles
    )


def semi_global(threads, cost, grey, prices, total):
    """Sum the costs of the cheapest paths along eight directions into `total`."""
    total[:] = ZERO
    for dy, dx in DIRECTIONS:
        groups = -(-(cost.shape[1] if dy else cost.shape[0]) // PATHS)
        parallel_for(threads, groups, add_paths, cost, grey, dy, dx, prices, total, pieces=groups)


@inline
def sum_of_seven(a, x):
    """a[x] + ... + a[x + 6]."""
    return a[x] + a[x + 1] + a[x + 2] + a[x + 3] + a[x + 4] + a[x + 5] + a[x + 6]


@exact
def columns_inside(turn, y, last_x, last_y, first, last):
    """The first and last of the columns `first` to `last` of row y that a homography maps into an image."""
    low = np.float64(first)
    high = np.float64(last)
    depth = turn[2, 0], turn[2, 1] * y + turn[2, 2]  # slope and value at column 0, as of all conditions
    for k in range(5):
        if k < 4:
            axis = k // 2
            coordinate = turn[axis, 0], turn[axis, 1] * y + turn[axis, 2]
            if k % 2 == 0:  # the coordinate is at least 0
                slope = coordinate[0] + MARGIN * depth[0]
                value = coordinate[1] + MARGIN * depth[1]
            else:  # and at most the last pixel's
                end = (last_y if axis else last_x) + MARGIN
                slope = end * depth[0] - coordinate[0]
                value = end * depth[1] - coordinate[1]
        else:  # and in front of the camera
            slope = depth[0]
            value = depth[1] - 1e-9
        if slope > 0.0:
            low = max(low, np.ceil(-value / slope))
        elif slope < 0.0:
            high = min(high, np.floor(-value / slope))
        elif value < 0.0:
            high = low - 1.0
    return np.int64(min(low, last + 1.0)), np.int64(max(high, first - 1.0))


@exact
def warp_row(turn, y, other, begin, end, places, weights, row, offset):
    """Write an image at the positions of columns `begin` to `end` - 1 of row y to `row`, from `offset` on; bilinear.

    Positions first: that loop is vector code on any processor, while pixels are gathered one by one on some.
    """
    stride = np.int32(other.shape[1])
    last_x = np.float64(other.shape[1] - 2)
    last_y = np.float64(other.shape[0] - 2)
    pixels = other.ravel()
    across_x, across_y, across_z = turn[0, 0], turn[1, 0], turn[2, 0]
    at_x = turn[0, 1] * y + turn[0, 2]
    at_y = turn[1, 1] * y + turn[1, 2]
    at_z = turn[2, 1] * y + turn[2, 2]
    for k in range(end - begin):
        x = np.float64(np.int32(begin) + np.int32(k))
        inverse = 1.0 / (across_z * x + at_z)
        u = (across_x * x + at_x) * inverse
        v = (across_y * x + at_y) * inverse
        u = u if u > 0.0 else 0.0
        v = v if v > 0.0 else 0.0
        u = u if u < last_x else last_x
        v = v if v < last_y else last_y
        column = np.int32(u)
        line = np.int32(v)
        weights[0, k] = f32(u - np.float64(column))
        weights[1, k] = f32(v - np.float64(line))
        places[k] = line * stride + column
    for k in range(end - begin):
        right = weights[0, k]
        down = weights[1, k]
        i = np.uint32(places[k])
        below = i + np.uint32(stride)
        upper = pixels[i] + right * (pixels[i + np.uint32(1)] - pixels[i])
        lower = pixels[below] + right * (pixels[below + np.uint32(1)] - pixels[below])
        row[offset + k] = upper + down * (lower - upper)


@exact
def compare_tiles(begin, end, image, mean, variance, constants, others, homographies, cost):
    """Normalised cross-correlation of windows, tile by tile, in the images that show the whole window."""
    flat, unseen, alone = constants
    height, width, planes = cost.shape
    tiles_across = -(-width // TILE_COLUMNS)
    share = 1.0 / SIDE**2
    places = np.empty(TILE_COLUMNS + 2 * HALO, np.int32)  # of the pixels of a row
    weights = np.empty((2, TILE_COLUMNS + 2 * HALO), np.float32)  # to the right and below them
    row = np.zeros(TILE_COLUMNS + 2 * HALO, np.float32)
    rows = np.zeros((SIDE, TILE_COLUMNS + 2 * HALO), np.float32)  # the last ones
    sums = np.zeros((3, TILE_COLUMNS + 2 * HALO))  # of these rows' columns: warped, its square, its product
    s0, s1, s2 = sums[0], sums[1], sums[2]
    limits = np.zeros((2, SIDE), np.int64)  # the columns of these rows inside the other image
    best = np.empty((TILE_ROWS, LANES, TILE_COLUMNS), np.float32)
    second = np.empty_like(best)
    for tile in range(begin, end):
        top = tile // tiles_across * TILE_ROWS
        left = tile % tiles_across * TILE_COLUMNS
        bottom = min(top + TILE_ROWS, height)
        columns = min(left + TILE_COLUMNS, width) - left
        first = max(left - HALO, 0)
        last = min(left + columns + HALO, width) - 1
        for plane in range(0, planes, LANES):
            lanes = min(LANES, planes - plane)
            best[:] = -INFINITY
            second[:] = -INFINITY
            for n in range(len(others)):
                for p in range(lanes):
                    turn = homographies[n, plane + p]
                    rows[:] = ZERO
                    sums[:] = 0.0
                    for y in range(top - HALO, bottom + HALO):
                        inside = min(max(y, 0), height - 1)
                        slot = (y - top + HALO) % SIDE
                        low, high = columns_inside(turn, inside, width - 1.0, height - 1.0, first, last)
                        limits[0, slot] = low
                        limits[1, slot] = high
                        row[:] = ZERO
                        if low <= high:
                            warp_row(turn, inside, others[n], low, high + 1, places, weights, row, low - left + HALO)
                        for x in range(first - left + HALO):
                            row[x] = row[first - left + HALO]  # the border is replicated
                        for x in range(last - left + HALO + 1, columns + 2 * HALO):
                            row[x] = row[last - left + HALO]
                        own = image[y + HALO, left:]
                        own_gone = image[max(y + HALO - SIDE, 0), left:]
                        oldest = rows[slot]
                        for x in range(columns + 2 * HALO):
                            new = np.float64(row[x])
                            gone = np.float64(oldest[x])
                            s0[x] += new - gone
                            s1[x] += new * new - gone * gone
                            s2[x] += new * np.float64(own[x]) - gone * np.float64(own_gone[x])
                            oldest[x] = row[x]
                        middle = y - HALO
                        if middle < top:
                            continue
                        low = limits[0].max()
                        high = limits[1].min()
                        low = low + HALO if low > 0 else 0
                        high = high - HALO if high < width - 1 else width - 1
                        highest = best[middle - top, p]
                        other = second[middle - top, p]
                        own_mean = mean[middle, left:]
                        own_variance = variance[middle, left:]
                        for x in range(columns):
                            warped_mean = sum_of_seven(s0, x) * share
                            spread = f32(sum_of_seven(s1, x) * share - warped_mean * warped_mean)
                            spread = spread if spread > ZERO else ZERO
                            product = f32(sum_of_seven(s2, x) * share - own_mean[x] * warped_mean)
                            score = product / np.sqrt((own_variance[x] + flat) * (spread + flat))
                            column = np.int32(left) + np.int32(x)
                            score = score if np.int32(low) <= column <= np.int32(high) else -INFINITY
                            lower = score if score < highest[x] else highest[x]
                            highest[x] = highest[x] if score < highest[x] else score
                            other[x] = lower if lower > other[x] else other[x]
            for y in range(top, bottom):
                for p in range(lanes):
                    highest = best[y - top, p]
                    other = second[y - top, p]
                    for x in range(columns):
                        score = highest[x]
                        if len(others) > 1:
                            lower = other[x] if other[x] > -INFINITY else alone * score
                            score = f32(0.75) * score + f32(0.25) * lower
                        highest[x] = score if score > -INFINITY else unseen
                for x in range(columns):
                    out = cost[y, left + x]
                    for p in range(lanes):
                        out[plane + p] = ONE - best[y - top, p, x]


@exact
def add_paths(begin, end, cost, grey, dy, dx, prices, total):
    """Add the costs of the cheapest paths in one direction, `PATHS` of them at a time; they wrap around at the sides.

    A path continues that of the same plane, of one beside it for a price, or of any for another, lower at edges.
    """
    height, width, planes = cost.shape
    step, jump, edge, min_jump = prices
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
                    cheapest_before = lowest[k]
                    price = ONE / (edge + slope) * jump
                    anywhere = cheapest_before + (price if price > min_jump else min_jump)
                    for d in range(planes):
                        cheapest = previous[1 + d] if previous[1 + d] < anywhere else anywhere
                        left, right = previous[d] + step, previous[2 + d] + step
                        cheapest = left if left < cheapest else cheapest
                        cheapest = right if right < cheapest else cheapest
                        path[1 + d] = here[d] + (cheapest - cheapest_before)
                lanes[:] = INFINITY
                for d in range(0, size, LANES):
                    for lane in range(LANES):
                        value = path[1 + d + lane]
                        lanes[lane] = value if value < lanes[lane] else lanes[lane]
                lowest[k] = lanes.min()
                for d in range(planes):
                    out[d] += path[1 + d]
