"""Soft daylight on a mesh: many distant lamps, each with a depth map of what it sees first (a shadow map).

Source: L. Williams, "Casting Curved Shadows on Curved Surfaces", SIGGRAPH 1978. A close bundle of lamps is the sun,
with penumbras; lamps spread over half a sphere are the sky, which leaves corners and the room under a table darker.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from .raycast import Array, raycast

MAP_SIZE = 288  # pixels along each side of a depth map
DISTANCE = 30.0  # m from the middle of the casters to each lamp
LIFT = 0.012  # m above its surface at which a point looks for lamps: higher than the steps of the depth maps
AMBIENT = np.float32(0.16)  # what reaches every point
NUM_SUN = 6  # lamps of the sun
NUM_SKY = 18  # lamps of the sky
SUN_COLOR = (0.74, 0.68, 0.58)
SKY_COLOR = (0.5, 0.54, 0.6)


class Lights(NamedTuple):
    """L lamps, float32."""

    directions: NDArray[np.float32]  # (L, 3), unit, towards the lamps
    colors: NDArray[np.float32]  # (L, 3), what a surface that faces the lamp gets
    rows: NDArray[np.float32]  # (3, 4, L): to u z, v z and z in the lamps' depth maps
    depths: NDArray[np.float32]  # (L, S, S), infinite where nothing is hit


def daylight(casters: Array, sun: Array, sky: Array) -> Lights:
    """Lamps around triangles `(F, 3, 3)`: a sun, and a sky that is half a sphere.

    `sun` and `sky` `(3,)` are unit vectors from the scene towards the sun and towards the middle of the sky.
    """
    low, high = casters.min(axis=(0, 1)), casters.max(axis=(0, 1))
    middle = (low + high) / 2
    radius = np.linalg.norm(high - low) / 2
    directions = np.concatenate([_cap(sun, NUM_SUN, 0.9985), _cap(sky, NUM_SKY, 0.0)])
    colors = np.repeat([SUN_COLOR, SKY_COLOR], [NUM_SUN, NUM_SKY], axis=0)
    colors /= np.repeat([NUM_SUN, 0.5 * NUM_SKY], [NUM_SUN, NUM_SKY])[:, None]  # 0.5: the mean cosine
    focal = 0.5 * (MAP_SIZE - 2) * np.sqrt(DISTANCE**2 - radius**2) / radius
    center = (MAP_SIZE - 1) / 2
    intrinsics = np.array([[focal, 0, center], [0, focal, center], [0, 0, 1.0]])
    poses = np.tile(np.eye(4), (len(directions), 1, 1))
    for pose, direction in zip(poses, directions, strict=True):
        pose[:3, :3] = _frame(-direction).T
        pose[:3, 3] = -pose[:3, :3] @ (middle + DISTANCE * direction)

    def depth_map(pose: Array) -> Array:
        depth, faces = raycast(casters, intrinsics, pose, (MAP_SIZE, MAP_SIZE))
        return np.where(faces < 0, np.inf, depth)

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        depths = list(pool.map(depth_map, poses))
    rows = np.stack([intrinsics @ pose[:3] for pose in poses], axis=-1)
    return Lights(*(np.asarray(x, np.float32) for x in (directions, colors, rows, depths)))


def received(lights: Lights, points: Array, normals: Array) -> NDArray[np.float32]:
    """The light `(n, 3)` on points `(n, 3)` with unit normals `(n, 3)`: Lambert's cosine, over all lamps in sight."""
    lifted = np.concatenate([points + LIFT * normals, np.ones((len(points), 1))], axis=1).astype(np.float32)
    size = lights.depths.shape[1]
    first = np.arange(len(lights.depths)) * lights.depths[0].size
    u, v, z = (lifted @ matrix for matrix in lights.rows)
    column, line = ((x / z + np.float32(0.5)).clip(0, size - 1).astype(np.int32) for x in (u, v))
    nearest = lights.depths.take(first + line * size + column)
    cosines = (normals.astype(np.float32) @ lights.directions.T).clip(0)
    light: NDArray[np.float32] = AMBIENT + (cosines * (z < nearest + LIFT / 2)) @ lights.colors
    return light


def _cap(axis: Array, count: int, minimum: float) -> Array:
    """Directions `(count, 3)` spread evenly over the cap whose angle to the axis has at least that cosine."""
    k = np.arange(count) + 0.5
    cosine = 1 - (1 - minimum) * k / count
    turn = k * np.pi * (3 - np.sqrt(5))
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1) @ _frame(axis).T


def _frame(axis: Array) -> Array:
    """A rotation whose third column is the axis."""
    right = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(axis, right), axis], axis=-1)
