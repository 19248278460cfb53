"""A posed scene of ten photos in each layout, written from what the format says of axes, pixels and names.

Photo `i` is called `img{i}.png` and has the grey value `i`; photos 0 and 8 are the test views.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

WIDTH, HEIGHT, COUNT = 48, 32, 10
TEST = (0, 8)
FAR = np.array([100.0, -200.0, 0.0])  # the world is far from the origin, as georeferenced ones are
WORLD_POINT = FAR + np.array([0.3, -0.2, 6.0])

Pose = tuple[np.ndarray, np.ndarray]  # the rotation and the translation from world to camera: right, down, forward
Lens = tuple[float, float, float, float]  # two focal lengths and the principal point; the first pixel ends at 1
CENTRED: Lens = (40.0, 40.0, WIDTH / 2, HEIGHT / 2)
UNLIKE: Lens = (40.0, 42.0, 21.0, 14.5)


def poses(seed: int = 0) -> list[Pose]:
    """Cameras that look at `WORLD_POINT`, roughly."""
    rng = np.random.default_rng(seed)
    turns = [cv2.Rodrigues(rng.normal(0, 0.05, 3))[0] for _ in range(COUNT)]
    return [(turn, rng.normal(0, 0.4, 3) - turn @ FAR) for turn in turns]


def pixel_of(pose: Pose, lens: Lens) -> np.ndarray:
    """Where a photo shows `WORLD_POINT`; the centre of the first pixel is at 1/2."""
    rotation, translation = pose
    x, y, z = rotation @ WORLD_POINT + translation
    return np.array([lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]])


def moved(pose: Pose, lens: Lens, pixel: np.ndarray) -> Pose:
    """The camera moved sideways until it sees `WORLD_POINT` at this pixel."""
    rotation, translation = pose
    z = (rotation @ WORLD_POINT + translation)[2]
    shift = (pixel - pixel_of(pose, lens)) / lens[:2] * z
    return rotation, translation + np.append(shift, 0.0)


def write_photo(path: Path, value: int, channels: int = 3) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((HEIGHT, WIDTH, channels), value, np.uint8)
    image[..., 3:] = 255
    cv2.imwrite(str(path), image)


def llff_rows(cameras: Sequence[Pose]) -> np.ndarray:
    """Columns of a row's matrix: down, right, backward, the centre, (height, width, focal length); two depths behind.

    They are of photos of twice the size.
    """
    array = np.ones((COUNT, 17))
    for row, (rotation, translation) in zip(array, cameras, strict=True):
        right, down, forward = rotation
        size = [2 * HEIGHT, 2 * WIDTH, 2 * CENTRED[0]]
        row[:15] = np.stack([down, right, -forward, -rotation.T @ translation, size], axis=1).ravel()
    return array


def write_rows(root: Path, array: np.ndarray, folder: str = "images_2") -> None:
    for i in range(COUNT):
        write_photo(root / folder / f"img{i}.png", i)
    np.save(root / "poses_bounds.npy", array)


def write_llff(root: Path, cameras: Sequence[Pose]) -> None:
    write_rows(root, llff_rows(cameras))


def opengl(pose: Pose) -> list[list[float]]:
    """Camera to world; columns right, up, backward, the centre."""
    rotation, translation = pose
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.T * [1, -1, -1]
    matrix[:3, 3] = -rotation.T @ translation
    return matrix.tolist()


def write_blender(root: Path, cameras: Sequence[Pose]) -> None:
    frames: dict[str, list[dict[str, Any]]] = {"train": [], "test": []}
    for i, pose in enumerate(cameras):
        split = "test" if i in TEST else "train"
        frames[split].append({"file_path": f"./{split}/img{i}", "rotation": 0.1, "transform_matrix": opengl(pose)})
        write_photo(root / split / f"img{i}.png", i, channels=4)
    angle = 2 * math.atan(WIDTH / 2 / CENTRED[0])
    for split, those in frames.items():
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": those}))


def write_nerfstudio(root: Path, cameras: Sequence[Pose]) -> None:
    """Frames are listed backwards."""
    lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), UNLIKE, strict=True))
    frames = []
    for i, pose in reversed(list(enumerate(cameras))):
        frames.append({"file_path": f"./images/img{i}.png", "transform_matrix": opengl(pose)})
        write_photo(root / "images" / f"img{i}.png", i)
    content = {"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, **lens, "frames": frames}
    (root / "transforms.json").write_text(json.dumps(content))


def write_colmap(
    root: Path,
    cameras: Sequence[Pose] | None = None,
    text: bool = False,
    model: str = "PINHOLE",
    params: Sequence[float] = CENTRED,
    names: Sequence[str] = tuple(f"img{i}.png" for i in range(COUNT)),
) -> None:
    """As pycolmap writes it; photo i has the id 100 - i, so ids sort backwards."""
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap writes the models")
    scene = pycolmap.Reconstruction()
    scene.add_camera_with_trivial_rig(
        pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params, camera_id=7)
    )
    for i, (rotation, translation) in reversed(list(enumerate(cameras or poses()))):
        seen = pycolmap.Point2DList([pycolmap.Point2D(np.array([3.0, 4.0])) for _ in range(i % 3)])
        image = pycolmap.Image(name=names[i], camera_id=7, image_id=100 - i, points2D=seen)
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation))
    # the first point is seen by images 1, 4 and 7, the second by 2 and 8
    for position, color, views, slot in (
        (WORLD_POINT, (255, 0, 51), (1, 4, 7), 0),
        (WORLD_POINT + 1, (0, 51, 255), (2, 8), 1),
    ):
        track = pycolmap.Track()
        for view in views:
            track.add_element(100 - view, slot)
        scene.add_point3D(position, track, np.array(color, np.uint8))
    (root / "sparse" / "0").mkdir(parents=True)
    (scene.write_text if text else scene.write_binary)(str(root / "sparse" / "0"))
    for i, name in enumerate(names):
        write_photo(root / "images" / name, i)


def write_colmap_text(root: Path, cameras: Sequence[Pose]) -> None:
    write_colmap(root, cameras, text=True, params=UNLIKE)


LAYOUTS: dict[str, tuple[Callable[[Path, Sequence[Pose]], None], Lens]] = {
    "LLFF": (write_llff, CENTRED),
    "COLMAP": (write_colmap, CENTRED),
    "COLMAP, text": (write_colmap_text, UNLIKE),
    "Blender": (write_blender, CENTRED),
    "nerfstudio": (write_nerfstudio, UNLIKE),
}
