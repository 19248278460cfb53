"""What transforms*.json files say of lenses, in both layouts that have them: used or refused, never passed over."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from tiny_scenes import write_transforms

from kgs.datasets import load_scene

WIDTH, HEIGHT, COUNT = 40, 30, 4
LENS: dict[str, Any] = {"fl_x": 50.0, "fl_y": 52.0, "cx": 21.0, "cy": 14.5, "w": WIDTH, "h": HEIGHT}
BOTH = pytest.mark.parametrize("layout", ["nerfstudio", "blender"])


def write(root: Path, layout: str, top: dict[str, Any], *own: dict[str, Any], suffix: str = ".png") -> Path:
    """Frame i has what `own[i]` says; returns the file that holds the training views, the second frame first."""
    (root / "images").mkdir(exist_ok=True)
    for i in range(COUNT):
        cv2.imwrite(str(root / "images" / f"{i}.png"), ramps())
    said = [*own, *[{}] * (COUNT - len(own))]
    if layout == "nerfstudio":
        every = {f"images/{i}{suffix}": said[i] for i in range(COUNT)}
        return write_transforms(root / "transforms.json", top, every)
    write_transforms(root / "transforms_test.json", top, {f"images/0{suffix}": said[0]})
    train = {f"images/{i}{suffix}": said[i] for i in range(1, COUNT)}
    return write_transforms(root / "transforms_train.json", top, train)


def ramps() -> np.ndarray:
    """A picture whose red and green say column and row."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([np.zeros_like(rows), rows * 1000, columns * 1000], axis=2).astype(np.uint16)


def check_undistorted(root: Path, coefficients: tuple[float, ...], fisheye: bool, view: int = 0) -> None:
    """Each pixel of the loaded picture comes from where OpenCV's projection puts its ray."""
    scene = load_scene(root)
    matrix = scene.train.cameras.intrinsics[view, :3, :3].double().numpy()
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=2).reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    given = np.array([[50, 0, 20.5], [0, 52, 14], [0, 0, 1]])
    rays = pixels @ np.linalg.inv(matrix).T
    expected = project(rays, np.zeros(3), np.zeros(3), given, np.array(coefficients))[0].reshape(-1, 2)
    got = scene.train.images[view, :2].permute(1, 2, 0).reshape(-1, 2).numpy() * 65.535
    np.testing.assert_allclose(got, expected, atol=0.02)


@BOTH
def test_convention_fisheye_of_instant_ngp_is_opencvs(tmp_path: Path, layout: str) -> None:
    write(tmp_path, layout, {**LENS, "is_fisheye": True, "k1": 0.05, "k2": -0.02, "k3": 0.01, "k4": 0.002, "p1": 0})
    check_undistorted(tmp_path, (0.05, -0.02, 0.01, 0.002), fisheye=True)


@BOTH
def test_a_frame_of_its_own_model_among_others(tmp_path: Path, layout: str) -> None:
    fish = {"camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": 0.001}
    write(tmp_path, layout, {**LENS, "camera_model": "OPENCV", "k1": -0.05, "p1": 0.001, "is_fisheye": None}, {}, fish)
    check_undistorted(tmp_path, (0.02, -0.01, 0.003, 0.001), fisheye=True)
    check_undistorted(tmp_path, (-0.05, 0, 0.001, 0), fisheye=False, view=1)


@BOTH
def test_lenses_of_own_data(tmp_path: Path, layout: str) -> None:
    distortion = {"k1": -0.1, "k2": 0.02, "p1": 0.004, "p2": -0.003, "k3": 0.01}
    write(tmp_path, layout, {**LENS, "camera_angle_x": 0.76, **distortion})
    check_undistorted(tmp_path, (-0.1, 0.02, 0.004, -0.003, 0.01), fisheye=False)
    write(tmp_path, layout, LENS, {}, {"cx": 19.0})
    cameras = load_scene(tmp_path).train.cameras
    np.testing.assert_allclose(cameras.intrinsics[0, :2, :3], [[50, 0, 18.5], [0, 52, 14]], atol=1e-6)
    np.testing.assert_allclose(cameras.intrinsics[1, :2, :3], [[50, 0, 20.5], [0, 52, 14]], atol=1e-6)


def focal(length: float, angle: float) -> float:
    return length / 2 / math.tan(angle / 2)


@BOTH
@pytest.mark.parametrize(
    ("top", "own", "expected"),
    [
        ({"camera_angle_x": 0.8}, {}, (focal(WIDTH, 0.8), focal(WIDTH, 0.8))),
        ({"camera_angle_x": 0.8, "camera_angle_y": 0.5}, {}, (focal(WIDTH, 0.8), focal(HEIGHT, 0.5))),
        ({"camera_angle_y": 0.5}, {}, (focal(HEIGHT, 0.5), focal(HEIGHT, 0.5))),
        ({"fl_y": 44.0}, {}, (44.0, 44.0)),
        ({"fl_x": 55.0, "camera_angle_y": 0.5}, {}, (55.0, focal(HEIGHT, 0.5))),
        ({"camera_angle_x": 0.8}, {"camera_angle_x": 0.6}, (focal(WIDTH, 0.6), focal(WIDTH, 0.6))),
        ({"fl_x": 55.0, "fl_y": 56.0}, {"camera_angle_x": 0.6}, (focal(WIDTH, 0.6), 56.0)),
        ({"fl_x": 55.0, "fl_y": 56.0}, {"fl_x": 70.0}, (70.0, 56.0)),
        ({"fl_x": 110.0, "fl_y": 112.0, "w": 80, "h": 60}, {}, (55.0, 56.0)),
        ({"camera_angle_x": 0.8, "w": 80, "h": 60}, {}, (focal(WIDTH, 0.8), focal(WIDTH, 0.8))),
    ],
)
def test_focal_lengths_and_fields_of_view(
    tmp_path: Path, layout: str, top: dict[str, Any], own: dict[str, Any], expected: tuple[float, float]
) -> None:
    write(tmp_path, layout, top, {}, own)
    cameras = load_scene(tmp_path).train.cameras
    np.testing.assert_allclose([float(cameras.fx[0]), float(cameras.fy[0])], expected, rtol=1e-6)


@BOTH
@pytest.mark.parametrize("key", ["sharpness", "pose_confidence", "aabb_scale", "note"])
def test_what_is_not_used_may_be_not_finite(tmp_path: Path, layout: str, key: str) -> None:
    path = write(tmp_path, layout, LENS, {}, {key: 1234.5})
    path.write_text(path.read_text().replace("1234.5", "NaN"))
    assert len(load_scene(tmp_path).train) == COUNT - 1


DESCRIPTIONS: list[dict[str, Any]] = [
    {"aabb_scale": 16, "applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]], "applied_scale": 0.5},
    {"orientation_override": "none", "scale": 0.3, "offset": [0.5, 0.5, 0.5]},
    {"is_fisheye": False, "k3": 0, "k4": 0.0, "distortion_params": [0.0, 0, 0], "mask_path": "", "latlong": False},
    {"sharpness": 30.1, "rotation": 0.01, "colmap_im_id": 1},
    {"camera_make": "Apple", "camera_model": "iPhone 15 Pro", "lens_model": "iPhone 15 Pro back camera 6.86mm f/1.78"},
    {"shutter_speed": 0.008, "max_resolution": 3200, "center_depth": 2.5, "pose_confidence": 0.9},
    {"camera_type": "perspective", "sensor_width": 36.0, "sensor_height": 24.0},
    {"image_width": WIDTH, "image_height": HEIGHT, "width": WIDTH, "height": float(HEIGHT)},
]


@BOTH
@pytest.mark.parametrize("where", ["top", "frame"])
@pytest.mark.parametrize("said", DESCRIPTIONS)
def test_what_describes_a_camera_or_a_tool_is_passed_over(
    tmp_path: Path, layout: str, where: str, said: dict[str, Any]
) -> None:
    write(tmp_path, layout, LENS)
    before = load_scene(tmp_path).train.cameras
    write(tmp_path, layout, {**LENS, **(said if where == "top" else {})}, {}, said if where == "frame" else {})
    scene = load_scene(tmp_path)
    assert scene.notes == ()
    assert scene.train.cameras.intrinsics.equal(before.intrinsics)
    assert scene.train.cameras.extrinsics.equal(before.extrinsics)


@BOTH
def test_other_things_that_are_not_used_are_noted(tmp_path: Path, layout: str) -> None:
    path = write(tmp_path, layout, {**LENS, "ply_file_path": "sparse.ply"}, {}, {"depth_file_path": "d/1.png"})
    (note,) = {note for note in load_scene(tmp_path).notes if path.name in note}
    assert note == f"{path.name}: not used: depth_file_path, ply_file_path"


@BOTH
@pytest.mark.parametrize(
    ("written", "stored"),
    [(".png", ".png"), ("", ".png"), ("", ".PNG"), ("", ".jpg"), ("", ".JPEG"), (".jpg", ".jpg"), ("", ".webp")],
)
def test_photos_are_found_whatever_their_ending(tmp_path: Path, layout: str, written: str, stored: str) -> None:
    write(tmp_path, layout, LENS, suffix=written)
    for path in list((tmp_path / "images").iterdir()):
        cv2.imwrite(str(path.with_suffix(stored)), np.full((HEIGHT, WIDTH, 3), 80, np.uint8))
        if stored != ".png":
            path.unlink()
    scene = load_scene(tmp_path)
    assert scene.train.names == tuple(f"images/{i}{stored}" for i in range(1, COUNT))
    assert float((scene.train.images - 80 / 255).abs().max()) < 0.01


@BOTH
def test_byte_order_marks_backslashes_and_poses_of_three_rows(tmp_path: Path, layout: str) -> None:
    path = write(tmp_path, layout, LENS)
    before = load_scene(tmp_path).train
    text = path.read_text().replace("images/", "images\\\\").replace(", [0.0, 0.0, 0.0, 1.0]]", "]")
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    after = load_scene(tmp_path).train
    assert after.names == before.names
    assert after.cameras.extrinsics.equal(before.cameras.extrinsics)


@BOTH
def test_poses_of_three_digits_become_rotations(tmp_path: Path, layout: str) -> None:
    path = write(tmp_path, layout, LENS)
    before = load_scene(tmp_path).train.cameras.extrinsics
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        frame["transform_matrix"] = [[round(x, 3) for x in row] for row in frame["transform_matrix"]]
    path.write_text(json.dumps(content))
    after = load_scene(tmp_path).train.cameras.extrinsics
    assert not torch.equal(after, before)
    torch.testing.assert_close(after, before, atol=4e-3, rtol=0)
    rotation = after[:, :3, :3].double()
    assert float((rotation.mT @ rotation - torch.eye(3)).abs().max()) < 1e-6


@pytest.mark.parametrize(
    ("lists", "train", "test"),
    [
        ({"train": [3, 1], "test": [2]}, (1, 3), (2,)),
        ({"train": [3, 1], "val": [0], "test": [2]}, (1, 3), (2,)),
        ({"train": [3, 1], "val": [0, 2]}, (1, 3), (0, 2)),
        ({"test": [1]}, (0, 2, 3), (1,)),
        ({"val": [1], "test": [1]}, (0, 2, 3), (1,)),
        ({"train": [0, 1, 2]}, (0, 1, 2), (3,)),
    ],
)
def test_the_files_own_split(
    tmp_path: Path, lists: dict[str, list[int]], train: tuple[int, ...], test: tuple[int, ...]
) -> None:
    names = {f"{key}_filenames": [f"./images/{i}.png" for i in value] for key, value in lists.items()}
    write(tmp_path, "nerfstudio", {**LENS, **names})
    scene = load_scene(tmp_path)
    assert scene.train.names == tuple(f"images/{i}.png" for i in train)
    assert scene.test.names == tuple(f"images/{i}.png" for i in test)
    assert any("neither" in note for note in scene.notes) == (len(train) + len(test) < COUNT)
    assert load_scene(tmp_path, 2).train.names == (scene.train.names[0], scene.train.names[-1])
