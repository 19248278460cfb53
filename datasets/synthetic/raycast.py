"""The first triangle along the ray of each pixel: exact depth of a mesh, without a renderer.

Source: M. Olano, T. Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates", Graphics Hardware 1997.

A ray r meets the triangle (a, b, c) of the camera frame at t r = w0 a + w1 b + w2 c with w0 + w1 + w2 = 1. Without the
last condition w is proportional to (b x c, c x a, a x b) . r, linear in the pixel, so nothing is divided by the depth
of a vertex and triangles that reach behind the camera need no clipping. Two triangles with a common edge get exactly
opposite numbers for it: a closed mesh has no cracks.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kgs._support.errors import ArgumentError

Array = NDArray[np.float64]
Index = NDArray[np.int64]
MARGIN = 1e-6  # px by which bounding boxes are widened, so that rounding never loses a pixel on an edge
CHUNK = 1 << 14  # pairs of a triangle and a pixel at a time, so that all arrays stay in the cache


class _Faces(NamedTuple):
    """F triangles in a camera, and the pixels that they may cover: none for those behind it or seen from the edge."""

    edges: Array  # (3, 3, F): w_i = edges[i] . (u, v, 1), not yet divided by the determinants
    det: Array  # (F,), > 0, of the corners in the camera frame
    low: Index  # (F, 2), first column and row
    high: Index  # (F, 2), last column and row
    counts: Index  # (F,), pixels


def raycast(triangles: Array, intrinsics: Array, extrinsics: Array, size: tuple[int, int]) -> tuple[Array, Index]:
    """The nearest triangle `(F, 3, 3)` that the ray through each pixel centre hits, seen from both sides.

    Returns the hit's z in the camera frame, `(H, W)`, 0 where there is none, and the triangle, int64, -1 for none. Of
    triangles that are equally near it is the last one.

    Convention:
        Kornia's: world-to-camera extrinsics, OpenCV axes (x right, y down, z forward), integer pixel centres.
    """
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
        raise ArgumentError("triangles", "shape (F, 3, 3)", triangles.shape)
    faces = _project(triangles, intrinsics[:3, :3], extrinsics, size)
    depths = np.full(size, np.inf)
    nearest = np.full(size, -1, dtype=np.int64)
    for start, stop in _chunks(faces.counts):
        if stop - start == 1:
            _cast_one(faces, start, depths, nearest)
        else:
            _cast_many(faces, start, stop, depths, nearest)
    depths[nearest < 0] = 0.0
    return depths, nearest


def _project(triangles: Array, intrinsics: Array, extrinsics: Array, size: tuple[int, int]) -> _Faces:
    """Triangles with their bounding boxes: the whole image for those that cross z = 0."""
    a, b, c = corners = triangles.transpose(1, 0, 2) @ extrinsics[:3, :3].T + extrinsics[:3, 3]
    normals = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
    det = np.einsum("fi,fi->f", a, normals[0])
    edges = np.ascontiguousarray((normals @ np.linalg.inv(intrinsics)).transpose(0, 2, 1)) * np.sign(det)
    limits = np.array([size[1] - 1.0, size[0] - 1.0])
    projected = corners @ intrinsics.T
    z = projected[..., 2:]
    in_front = (z > 0).all(axis=0)
    pixels = projected[..., :2] / np.where(z > 0, z, 1.0)
    low = np.where(in_front, np.ceil(pixels.min(axis=0) - MARGIN).clip(0.0, limits + 1), 0.0).astype(np.int64)
    high = np.where(in_front, np.floor(pixels.max(axis=0) + MARGIN).clip(-1.0, limits), limits).astype(np.int64)
    spans = (high - low + 1).clip(0)
    counts = np.where((det != 0.0) & (z[..., 0] > 0).any(axis=0), spans[:, 0] * spans[:, 1], 0)
    return _Faces(edges, np.abs(det), low, high, counts)


def _chunks(counts: Index) -> Iterator[tuple[int, int]]:
    """Ranges of triangles in their order: of `CHUNK` pixels at most together, or one triangle of more."""
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        before = ends[start] - counts[start]
        stop = max(start + 1, int(np.searchsorted(ends, before + CHUNK, side="right")))
        if ends[stop - 1] > before:
            yield start, stop
        start = stop


def _cast_one(faces: _Faces, face: int, depths: Array, nearest: Index) -> None:
    """Enter one triangle where it is at least as near as those before it, some rows at a time."""
    left, top = faces.low[face]
    right, bottom = faces.high[face] + 1
    u = np.arange(left, right)
    rows = max(1, CHUNK // len(u))
    for start in range(top, bottom, rows):
        part = np.s_[start : min(start + rows, bottom), left:right]
        v = np.arange(part[0].start, part[0].stop)[:, None]
        w0, w1, w2 = (x * u + y * v + z for x, y, z in faces.edges[:, :, face])
        total = w0 + w1 + w2
        hit = (w0 >= 0) & (w1 >= 0) & (w2 >= 0) & (total > 0)
        distance = faces.det[face] / np.where(hit, total, 1.0)
        hit &= distance <= depths[part]
        np.copyto(depths[part], distance, where=hit)
        np.copyto(nearest[part], face, where=hit)


def _cast_many(faces: _Faces, start: int, stop: int, depths: Array, nearest: Index) -> None:
    """Enter triangles, of which a later one wins where two are equally near."""
    counts = faces.counts[start:stop]
    first = np.cumsum(counts) - counts
    widths = faces.high[start:stop, 0] - faces.low[start:stop, 0] + 1
    # 32 bits: numbers of a chunk, whose division is faster
    columns = np.stack([first, widths, *faces.low[start:stop].T, np.arange(start, stop)]).astype(np.int32)
    before, width, left, top, face = np.repeat(columns, counts, axis=1)
    row, column = np.divmod(np.arange(len(face), dtype=np.int32) - before, width)
    u = left + column
    v = top + row
    w0, w1, w2 = (x * u + y * v + z for x, y, z in np.repeat(faces.edges[:, :, start:stop], counts, axis=2))
    total = w0 + w1 + w2
    hit = np.flatnonzero((w0 >= 0) & (w1 >= 0) & (w2 >= 0) & (total > 0))
    face = face[hit]
    pixel = v[hit] * depths.shape[1] + u[hit]
    distance = faces.det[face] / total[hit]
    flat = depths.reshape(-1)
    np.minimum.at(flat, pixel, distance)
    is_nearest = distance == flat[pixel]
    nearest.reshape(-1)[pixel[is_nearest]] = face[is_nearest]
