"""Matches of keypoints along epipolar lines, as in `kgs.init_points.matching`; only rounding differs.

    lines           (N, 3), of the first view's keypoints in the second, normals of length 1
    pixels          (2, M), x and y of the second view's keypoints
    descriptors     (N, F) and (M, F), of both views

A distance without a candidate is infinite. Each band of rows has its own results for the columns, so that no two
threads write to the same element.
"""

import numpy as np

from kgs._support.compiled.kernel import ZERO, f32, jit
from kgs._support.compiled.threads import parallel_for

BANDS = 16
INFINITY = f32(np.inf)


def mutual_nearest(threads, lines, pixels, descriptors, line_distance, ratio, max_distance):
    """Descriptor distances and indices in both views, `(K,)`, of mutual nearest neighbours that pass the ratio test."""
    n = len(lines)
    m = pixels.shape[1]
    near1, rival1 = np.full((2, n), INFINITY)
    near2, rival2 = np.full((2, BANDS, m), INFINITY)
    match1 = np.zeros(n, np.int64)
    match2 = np.zeros((BANDS, m), np.int64)
    results = (near1, rival1, match1, near2, rival2, match2)
    parallel_for(threads, BANDS, find_nearest, lines, pixels, *descriptors, f32(line_distance), *results, pieces=BANDS)
    if not m:
        return near1[:0], match1[:0], match1[:0]
    rival2 = np.partition(np.concatenate([near2, rival2]), 1, axis=0)[1]
    match2 = np.take_along_axis(match2, near2.argmin(0)[None], 0)[0]
    clear = near1 < f32(ratio) * np.minimum(rival1, rival2[match1])
    rows = np.nonzero(clear & (near1 < f32(max_distance)) & (match2[match1] == np.arange(n)))[0]
    return near1[rows], rows, match1[rows]


@jit
def find_nearest(
    begin, end, lines, pixels, descriptors1, descriptors2, line_distance, near1, rival1, match1, near2, rival2, match2
):
    """The nearest candidate (the first of equal ones) and the second distance of each row and, by band, each column."""
    n = len(lines)
    m = pixels.shape[1]
    x, y = pixels[0], pixels[1]
    off = np.empty(m, np.float32)
    candidates = np.empty(m, np.int32)
    for band in range(begin, end):
        near = near2[band]
        rival = rival2[band]
        match = match2[band]
        for i in range(band * n // BANDS, (band + 1) * n // BANDS):
            a, b, c = lines[i, 0], lines[i, 1], lines[i, 2]
            for j in range(m):
                off[j] = abs(a * x[j] + b * y[j] + c)
            count = 0
            for j in range(m):  # without a branch: about one in a hundred is a candidate
                candidates[count] = j
                count += off[j] < line_distance
            for k in range(count):
                j = candidates[k]
                distance = ZERO
                for f in range(descriptors1.shape[1]):
                    difference = descriptors1[i, f] - descriptors2[j, f]
                    distance += difference * difference
                distance = np.sqrt(distance)
                if distance < near1[i]:
                    near1[i], rival1[i], match1[i] = distance, near1[i], j
                elif distance < rival1[i]:
                    rival1[i] = distance
                if distance < near[j]:
                    near[j], rival[j], match[j] = distance, near[j], i
                elif distance < rival[j]:
                    rival[j] = distance
