"""A synthetic scene with exact poses and exact depth: a table with books, a lamp, a plant and a mug, in a room.

Meshes are trimesh's; `raycast` finds the first surface of each pixel, where a procedural texture is evaluated: nothing
of kgs takes part in making the images. Four rays per pixel are averaged. The world depends on the seed only, never on
the cameras.
"""

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from numpy.typing import NDArray
from torch import Tensor

from kgs._support.default_device import on_cpu
from kgs._support.errors import ArgumentError
from kgs.datasets.scene import Scene, Views
from kgs.geometry.cameras import image_size, pinhole_cameras, resized, select, to

from . import room
from .raycast import Array, raycast
from .world import World

SUPERSAMPLING = 2  # rays along each side of a pixel


def synthetic_scene(
    train_views: int = 3, test_views: int = 6, size: tuple[int, int] = (126, 168), seed: int = 0
) -> Scene:
    """Make a scene in some seconds, without any file.

    Cameras face the table from a small patch, the test views between the training views and a little outside of them.

    Convention:
        Kornia's: world-to-camera extrinsics with OpenCV axes, integer pixel centres (cx = (W - 1) / 2). Float32.

    Args:
        train_views: at least 1.
        test_views: at least 0.
        size: (height, width) of all images in pixels. The field of view is 58 degrees along the longer side.
        seed: of positions, textures and cameras, at least 0. The same seed gives the same scene, without points.

    Raises:
        ValueError: a number is out of range.
    """
    for name, value, minimum in (
        ("train_views", train_views, 1),
        ("test_views", test_views, 0),
        ("size", min(size), 1),
        ("seed", seed, 0),
    ):
        if value < minimum:
            raise ArgumentError(name, f"at least {minimum}", value)
    world = _make_world(seed)
    train_eyes, test_eyes = _patch_eyes(train_views, test_views, np.random.default_rng([seed, 1]))
    with on_cpu():
        train = _views(world, train_eyes, size, "train")
        test = _views(world, test_eyes, size, "test")
        no_points = torch.zeros(0, 3, dtype=torch.float32)
        black = torch.zeros(3, dtype=torch.float32)
        return Scene(train, test, no_points, no_points, "none", black.double(), black, Path("synthetic"))


def views_beyond(out: float, count: int = 6, size: tuple[int, int] = (126, 168), seed: int = 0) -> Views:
    """Images of the synthetic scene from positions `out` times as far from the middle of the training cameras as these.

    The positions are evenly spread over an ellipse whose half axes are those of the patch of the training cameras,
    times `out`. All cameras look at the middle of the scene.

    Args:
        out: > 0; 1 is as far as the training cameras.
        count: of cameras, at least 1.
        size: as given to `synthetic_scene`.
        seed: as given to `synthetic_scene`.

    Raises:
        ValueError: a number is out of range.
    """
    if not 0.0 < out < np.inf or count < 1:
        raise ArgumentError("out, count", "a number > 0 and at least one camera", f"{out} and {count}")
    turn = 2 * np.pi * np.arange(count) / count
    circle = np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=-1)
    return _views(_make_world(seed), room.EYE + out * circle * room.PATCH, size, "beyond")


def synthetic_depths(cameras: PinholeCamera, seed: int = 0) -> Tensor:
    """The true depth of the synthetic scene at the pixel centres of any cameras.

    Convention:
        Kornia's: world-to-camera extrinsics with OpenCV axes, integer pixel centres; depth is z in the camera frame.

    Args:
        cameras: for example `scene.train.cameras`, all of one image size.
        seed: as given to `synthetic_scene`.

    Returns:
        Float64, `(C, 1, H, W)`; 0 where a camera sees past the scene.

    Raises:
        ValueError: the cameras differ in image size.
    """
    size = image_size(cameras)
    triangles = _make_world(seed).triangles
    matrices = zip(cameras.intrinsics.double().cpu(), cameras.extrinsics.double().cpu(), strict=True)
    depths = [raycast(triangles, k.numpy(), e.numpy(), size)[0] for k, e in matrices]
    return torch.from_numpy(np.stack(depths)[:, None])


_make_world = lru_cache(maxsize=2)(room.make_room)


def _views(world: World, eyes: Array, size: tuple[int, int], split: str) -> Views:
    """Images of a world from some positions `(V, 3)`; all cameras are upright and look at the middle of the scene."""
    (height, width) = size
    count = len(eyes)
    focal = room.FOCAL * max(size)
    matrix = [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
    extrinsics = torch.zeros(count, 4, 4, dtype=torch.float32)
    for i, eye in enumerate(eyes):
        # poses are rounded to float32 before rendering, so that the images are exactly those of the cameras
        extrinsics[i] = torch.from_numpy(_look_at(eye, room.CENTER))
    cameras = pinhole_cameras(extrinsics, torch.tensor(matrix, dtype=torch.float32), width, height)
    world.prepare()
    images = np.zeros((count, 3, height, width), dtype=np.float32)
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for i, image in enumerate(pool.map(lambda i: _render(world, select(cameras, i), size), range(count))):
            images[i] = image
    names = tuple(f"{split}_{i:02d}" for i in range(count))
    return Views(cameras, torch.from_numpy(images), names)


def _render(world: World, camera: PinholeCamera, size: tuple[int, int]) -> NDArray[np.float32]:
    """The image `(3, H, W)`: the mean over rays spread evenly over the square of each pixel."""
    s = SUPERSAMPLING
    fine_size = (size[0] * s, size[1] * s)
    fine = resized(to(camera, dtype=torch.float64), s, fine_size)
    matrix = fine.intrinsics[0, :3, :3].numpy()
    extrinsics = fine.extrinsics[0].numpy()
    depths, faces = raycast(world.triangles, matrix, extrinsics, fine_size)
    v, u = np.nonzero(faces >= 0)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).astype(np.float64) @ np.linalg.inv(matrix).T
    points = (rays * depths[v, u, None] - extrinsics[:3, 3]) @ extrinsics[:3, :3]
    colors = np.zeros((*faces.shape, 3), dtype=np.float32)
    colors[v, u] = world.shade(points, faces[v, u])
    total = sum(colors[i::s, j::s] for i in range(s) for j in range(s))
    image: NDArray[np.float32] = np.asarray(total / np.float32(s * s), np.float32).transpose(2, 0, 1)
    return image


def _patch_eyes(train: int, test: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Training cameras in a zigzag from left to right, test cameras spread over a patch 1.15 times as large."""
    x = np.linspace(-1.0, 1.0, train) if train > 1 else np.zeros(1)
    zigzag = np.stack([x, np.where(np.arange(train) % 2, 0.5, -0.5)], axis=-1)
    # M. Roberts' R2 sequence: evenly spread, however many there are
    spread = (rng.uniform(size=2) + np.outer(np.arange(test), [0.7548776662466927, 0.5698402909980532])) % 1.0
    flat = np.concatenate([zigzag, 1.15 * (2.0 * spread - 1.0)])
    eyes = room.EYE + room.PATCH * np.concatenate([flat, rng.uniform(-1.0, 1.0, size=(train + test, 1))], axis=1)
    return eyes[:train], eyes[train:]


def _look_at(eye: Array, target: Array) -> Array:
    """World-to-camera matrix of an upright camera: its x axis is level, its y axis points down."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose
