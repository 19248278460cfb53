"""The first triangle along the ray of each pixel: exact depth of a mesh, without a renderer.

Source: M. Olano, T. Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates", Graphics Hardware 1997.

A ray r meets the triangle (a, b, c) of the camera frame at t r = w0 a + w1 b + w2 c with w0 + w1 + w2 = 1. Without the
last condition w is proportional to (b x c, c x a, a x b) . r, linear in the pixel, so nothing is divided by the depth
of a vertex and triangles that reach behind the camera need no clipping. Two triangles with a common edge get exactly
opposite numbers for it: a closed mesh has no cracks.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
MARGIN = 1e-6  # px by which bounding boxes are widened, so that rounding never loses a pixel on an edge


def raycast(triangles: Array, intrinsics: Array, extrinsics: Array, size: tuple[int, int]) -> tuple[Array, Index]:
    """The nearest triangle `(F, 3, 3)` that the ray through each pixel centre hits, seen from both sides.

    Returns the hit's z in the camera frame, `(H, W)`, 0 where there is none, and the triangle, int64, -1 for none.

    Convention:
        Kornia's: world-to-camera extrinsics, OpenCV axes (x right, y down, z forward), integer pixel centres.
    """
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
        raise ValueError(f"triangles: expected shape (F, 3, 3), got {triangles.shape}")
    (height, width) = size
    intrinsics = intrinsics[:3, :3]
    a, b, c = corners = triangles.transpose(1, 0, 2) @ extrinsics[:3, :3].T + extrinsics[:3, 3]
    normals = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
    det = np.einsum("fi,fi->f", a, normals[0])
    # (3, 3, F): w_i = edges[i] . (u, v, 1), not yet divided by |det|
    edges = np.ascontiguousarray((normals @ np.linalg.inv(intrinsics)).transpose(0, 2, 1)) * np.sign(det)
    face, u, v = _candidates(corners @ intrinsics.T, det != 0.0, size)
    w0, w1, w2 = (x[face] * u + y[face] * v + z[face] for x, y, z in edges)
    total = w0 + w1 + w2
    hit = np.flatnonzero((w0 >= 0) & (w1 >= 0) & (w2 >= 0) & (total > 0))
    face = face[hit]
    pixel = v[hit] * width + u[hit]
    distance = np.abs(det[face]) / total[hit]
    depths = np.full(height * width, np.inf)
    np.minimum.at(depths, pixel, distance)
    nearest = distance == depths[pixel]
    faces = np.full(height * width, -1, dtype=np.int64)
    faces[pixel[nearest]] = face[nearest]
    depths[faces < 0] = 0.0
    return depths.reshape(size), faces.reshape(size)


def _candidates(projected: Array, valid: NDArray[np.bool_], size: tuple[int, int]) -> tuple[Index, Index, Index]:
    """All pairs (face, u, v) where the pixel lies in the face's bounding box: the whole image if it crosses z = 0."""
    limits = np.array([size[1] - 1.0, size[0] - 1.0])
    z = projected[..., 2:]
    in_front = (z > 0).all(axis=0)
    pixels = projected[..., :2] / np.where(z > 0, z, 1.0)
    low = np.where(in_front, np.ceil(pixels.min(axis=0) - MARGIN).clip(0.0, limits + 1), 0.0).astype(np.int64)
    high = np.where(in_front, np.floor(pixels.max(axis=0) + MARGIN).clip(-1.0, limits), limits).astype(np.int64)
    spans = (high - low + 1).clip(0)
    counts = np.where(valid & (z[..., 0] > 0).any(axis=0), spans[:, 0] * spans[:, 1], 0)
    face = np.repeat(np.arange(len(counts)), counts)
    local = np.arange(len(face)) - (np.cumsum(counts) - counts)[face]
    row, column = np.divmod(local, spans[face, 0])
    return face, low[face, 0] + column, low[face, 1] + row
