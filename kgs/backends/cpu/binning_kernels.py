"""Kernels that find which Gaussian reaches which tile, front to back; spans as in `kgs.backends.torch.binning`.

In depth order, for each of the n Gaussians that reach a row of tiles:

    heads     (n, 2) first row of tiles, numbered through all cameras, and how many
    geometry  (n, 8) what its spans follow from: x, y, half height, squared radius, xy/yy, det/yy, 1/yy, rightmost
    table     (n, 7 + F and more) what compositing reads: log2 o, x, y, two whitening vectors, features, its depth
"""

import math

import numpy as np

from kgs._support.compiled.kernel import ONE, TWO, ZERO, f32, inline, is_finite, jit
from kgs._support.compiled.lanes import WIDTH, load, store

SIZE = 8  # side of a tile; a constant, so that loops over pixels have a constant length
_BITS, _BUCKETS = 11, 2048
_ROOT = f32(math.sqrt(0.5 * math.log2(math.e)))  # exp(-q / 2) = 2^-(ROOT^2 q): folded into the whitening vectors
_WIDER = f32(1e-3)  # see kgs.geometry.projection.cut_squared
_INFINITY = f32(np.inf)


@inline
def variances(a0, a1, a2, b0, b1, b2, eps2d):
    """Entries xx, xy, yy and determinant of M M^T + e I for the rows a, b of M, see `kgs.geometry.covariance`."""
    xx, xy, yy = a0 * a0 + a1 * a1 + a2 * a2, a0 * b0 + a1 * b1 + a2 * b2, b0 * b0 + b1 * b1 + b2 * b2
    u, v, w = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    return xx + eps2d, xy, yy + eps2d, u * u + v * v + w * w + eps2d * (xx + yy) + eps2d * eps2d


@jit
def find_rows(begin, end, means2d, factors, opacities, eps2d, threshold, height, rows):
    """First row of tiles that the ellipse alpha >= threshold of each Gaussian touches, and how many, `(M, 2)`."""
    for g in range(begin, end):
        rows[g, 0] = rows[g, 1] = 0
        if not opacities[g] > ZERO:
            continue
        cut = TWO * math.log(opacities[g] / threshold) + _WIDER  # infinite for a threshold of 0
        if not cut > ZERO:
            continue
        f = factors[g]
        xx, _, yy, _ = variances(f[0, 0], f[0, 1], f[0, 2], f[1, 0], f[1, 1], f[1, 2], eps2d)
        if not is_finite(xx + yy):
            continue
        half_height = math.sqrt(cut * yy)
        top, bottom = np.ceil(means2d[g, 1] - half_height), np.floor(means2d[g, 1] + half_height)
        if bottom >= ZERO and top <= f32(height - 1) and bottom >= top:  # nothing that is not a number
            first = int(max(top, ZERO)) // SIZE
            rows[g, 0] = first
            rows[g, 1] = int(min(bottom, f32(height - 1))) // SIZE - first + 1


@jit
def sort_by_depth(depths, rows, ids, ranks):
    """Fill `ids` with the Gaussians that reach a row, nearest first, ties in their order; returns how many.

    A radix sort. `depths` are the bits of float32; `ranks` is the inverse, -1 for the others.
    """
    keys, spare_keys, spare_ids = np.empty_like(depths), np.empty_like(depths), np.empty_like(ids)
    sign, infinity = np.uint32(0x80000000), np.uint32(0x7F800000)
    n = 0
    for g in range(len(depths)):
        ranks[g] = -1
        if rows[g, 1] > 0:
            bits = depths[g]
            magnitude = bits & ~sign
            if magnitude > infinity:
                key = ~np.uint32(0)  # not a number: last
            elif bits > sign:
                key = ~bits
            else:  # -0 is 0
                key = magnitude | sign
            ids[n], keys[n] = g, key
            n += 1
    histogram = np.zeros((3, _BUCKETS), np.int64)
    for i in range(n):
        for d in range(3):
            histogram[d, (keys[i] >> np.uint32(_BITS * d)) & np.uint32(_BUCKETS - 1)] += 1
    for d in range(3):
        total = 0
        for b in range(_BUCKETS):
            histogram[d, b], total = total, total + histogram[d, b]
        for i in range(n):
            b = (keys[i] >> np.uint32(_BITS * d)) & np.uint32(_BUCKETS - 1)
            at = histogram[d, b]
            histogram[d, b] += 1
            spare_keys[at], spare_ids[at] = keys[i], ids[i]
        keys, spare_keys, ids, spare_ids = spare_keys, keys, spare_ids, ids
    for i in range(n):
        spare_ids[i] = ids[i]  # three passes: the result is in what was spare
        ranks[ids[i]] = i
    return n


@jit
def fill_tables(
    begin, end, ids, means2d, factors, opacities, features, depths, camera_ids, eps2d, threshold, image_rows, rows,
    channels, heads, geometry, table,
):  # fmt: skip
    """What is known of each Gaussian, in depth order; features are padded with 0 up to `channels`."""
    width = features.shape[1]
    for i in range(begin, end):  # reads that miss the caches, many under way at a time
        g = ids[i]
        heads[i, 0] = camera_ids[g] * image_rows + rows[g, 0]
        heads[i, 1] = rows[g, 1]
        table[i, 0], table[i, 1], table[i, 2] = opacities[g], means2d[g, 0], means2d[g, 1]
        for c in range(3):
            geometry[i, c], geometry[i, 3 + c] = factors[g, 0, c], factors[g, 1, c]
        for f in range(channels):
            table[i, 7 + f] = features[g, f] if f < width else ZERO
        for j in range(7 + channels, table.shape[1]):
            table[i, j] = depths[g]
    for i in range(begin, end):
        o, x, y = table[i, 0], table[i, 1], table[i, 2]
        a0, a1, a2, b0, b1, b2 = (geometry[i, 0], geometry[i, 1], geometry[i, 2], geometry[i, 3], geometry[i, 4],
                                  geometry[i, 5])  # fmt: skip
        cut = TWO * math.log(o / threshold) + _WIDER
        xx, xy, yy, det = variances(a0, a1, a2, b0, b1, b2, eps2d)
        geometry[i, 0], geometry[i, 1], geometry[i, 2], geometry[i, 3] = x, y, math.sqrt(cut * yy), cut
        geometry[i, 4], geometry[i, 5], geometry[i, 6] = xy / yy, det / yy, ONE / yy
        geometry[i, 7] = xy * math.sqrt(cut / xx)
        for j in range(8):
            geometry[i, j] = geometry[i, j] if is_finite(geometry[i, j]) else _INFINITY
        pivot = max(xx, yy)
        slope = -xy / pivot
        along, across = _ROOT / math.sqrt(pivot), _ROOT * math.sqrt(pivot / det)
        if o == _INFINITY:  # opaque everywhere
            along, across = ZERO, ZERO
        table[i, 0] = min(math.log2(o), f32(128))  # 2^128 is infinite already
        wide = xx >= yy
        table[i, 3], table[i, 4] = (slope * across, across) if wide else (across, slope * across)
        table[i, 5], table[i, 6] = (along, ZERO) if wide else (ZERO, along)


@jit
def begin_spans(heads, begin, end, starts):
    """Where the spans of each Gaussian in the rows `begin` to `end` start, and at last their number."""
    total = 0
    for i in range(len(heads)):
        starts[i] = total
        total += max(min(heads[i, 0] + heads[i, 1], end) - max(heads[i, 0], begin), 0)
    starts[len(heads)] = total


@jit
def find_spans(begin, end, first_row, last_row, image_rows, width, heads, geometry, starts, spans):
    """For each row of tiles of a Gaussian the columns that its ellipse touches: the first + 2^16 times how many."""
    for i in range(begin, end):
        x, y, half_height, cut = geometry[i, 0], geometry[i, 1], geometry[i, 2], geometry[i, 3]
        slope, across, inverse, rightmost = geometry[i, 4], geometry[i, 5], geometry[i, 6], geometry[i, 7]
        top = max(heads[i, 0], first_row)
        at = starts[i]
        for row in range(top, min(heads[i, 0] + heads[i, 1], last_row)):
            left, right = ZERO, f32(width - 1)
            if cut < _INFINITY:
                low = f32(row % image_rows * SIZE) - y
                high = min(low + f32(SIZE - 1), half_height)
                low = max(low, -half_height)
                dy = min(max(-rightmost, low), high)
                left = np.ceil(x + slope * dy - math.sqrt(max(cut - dy * dy * inverse, ZERO) * across))
                dy = min(max(rightmost, low), high)
                right = np.floor(x + slope * dy + math.sqrt(max(cut - dy * dy * inverse, ZERO) * across))
            span = 0
            if right >= ZERO and left <= f32(width - 1) and right >= left:  # nothing that is not a number
                span = int(max(left, ZERO)) // SIZE
                span += (int(min(right, f32(width - 1))) // SIZE - span + 1) << 16
            spans[at] = span
            at += 1


@jit
def count_rows(heads, starts, spans, spans_per_row, entries_per_row):
    """Add up spans and entries of each row of tiles, of spans of all rows."""
    for i in range(len(heads)):
        for r in range(heads[i, 1]):
            spans_per_row[heads[i, 0] + r] += 1
            entries_per_row[heads[i, 0] + r] += spans[starts[i] + r] >> 16


@jit
def find_members(heads, first_row, last_row, band_of_row, offsets, members):
    """The Gaussians of each band in depth order, one band behind the other."""
    for i in range(len(heads)):
        low, high = max(heads[i, 0], first_row), min(heads[i, 0] + heads[i, 1], last_row)
        if low < high:
            for band in range(band_of_row[low - first_row], band_of_row[high - 1 - first_row] + 1):
                offsets[band + 1] += 1
    for band in range(len(offsets) - 1):
        offsets[band + 1] += offsets[band]
    cursors = offsets.copy()
    for i in range(len(heads)):
        low, high = max(heads[i, 0], first_row), min(heads[i, 0] + heads[i, 1], last_row)
        if low < high:
            for band in range(band_of_row[low - first_row], band_of_row[high - 1 - first_row] + 1):
                members[cursors[band]] = i
                cursors[band] += 1


@jit
def count_entries(begin, end, first_row, columns, heads, starts, spans, members, offsets):
    """Where the entries of each tile in the rows `begin` to `end` start; `spans` begin with `first_row`."""
    for i in members:
        top, first = max(heads[i, 0], first_row), max(heads[i, 0], begin)
        for row in range(first, min(heads[i, 0] + heads[i, 1], end)):
            span = spans[starts[i] + row - top]
            tile = (row - begin) * columns + (span & 0xFFFF)
            offsets[tile] += 1  # by how much a tile has more than the one before
            offsets[tile + (span >> 16)] -= 1
    total = length = 0
    for tile in range(len(offsets)):
        length += offsets[tile]
        offsets[tile] = total
        total += length


@jit
def gather_rows(members, table, rows):
    """The rows of the table of all members. A loop of its own: with the next in one function both take longer."""
    for m in range(len(members)):
        row = table[members[m]]
        for j in range(0, table.shape[1], WIDTH):
            store(rows[m], j, load(row, j))


@jit
def fill_entries(begin, end, first_row, columns, heads, starts, spans, members, offsets, entries):
    """The members of each tile, front to back."""
    cursors = offsets.copy()
    for m in range(len(members)):
        i = members[m]
        top, first = max(heads[i, 0], first_row), max(heads[i, 0], begin)
        for row in range(first, min(heads[i, 0] + heads[i, 1], end)):
            span = spans[starts[i] + row - top]
            tile = ((row - begin) * columns + (span & 0xFFFF)) & 0x7FFFFFFF  # not negative: indices wrap
            for c in range(tile, tile + (span >> 16)):
                at = cursors[c] & 0x7FFFFFFFFFFFFFFF
                cursors[c] = at + 1
                entries[at] = m


@jit
def fill_band(begin, end, first_row, columns, heads, starts, spans, members, table, offsets, entries, rows):
    """The lists of a band and the rows of its members, in one call: calls by several threads wait for each other."""
    count_entries(begin, end, first_row, columns, heads, starts, spans, members, offsets)
    gather_rows(members, table, rows)
    fill_entries(begin, end, first_row, columns, heads, starts, spans, members, offsets, entries)
