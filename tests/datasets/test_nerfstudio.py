"""The nerfstudio loader, on files written here by hand and on the real scene."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from kgs.datasets import Scene, load_scene
from kgs.errors import DataError

WIDTH, HEIGHT, COUNT = 40, 30, 10
LENS: dict[str, Any] = {"camera_model": "OPENCV", "fl_x": 50.0, "fl_y": 52.0, "cx": 21.0, "cy": 14.5, "w": 40, "h": 30}
POINT = np.array([0.1, 0.2, 0.3])


def matrices(seed: int = 0) -> list[np.ndarray]:
    """Camera-to-world with OpenGL axes, about 4 in front of the origin."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(COUNT):
        matrix = np.eye(4)
        matrix[:3, :3] = cv2.Rodrigues(rng.normal(0, 0.05, 3))[0]
        matrix[:3, 3] = rng.normal((0, 0, 4), 0.2)
        result.append(matrix)
    return result


def pixel_of(matrix: np.ndarray, lens: dict[str, Any] = LENS) -> np.ndarray:
    """Half-pixel coordinates of `POINT`: OpenGL looks along -z, y is up, rows count downwards."""
    x, y, z = np.linalg.solve(matrix, [*POINT, 1])[:3]
    return np.array([lens["cx"] + lens["fl_x"] * x / -z, lens["cy"] - lens["fl_y"] * y / -z])


def write(root: Path, lens: dict[str, Any] = LENS, poses: list[np.ndarray] | None = None) -> None:
    """Frames are listed backwards: 9, 8, ..., 0."""
    (root / "images").mkdir(exist_ok=True)
    frames = [
        {"file_path": f"./images/{i:04d}.png", "transform_matrix": matrix.tolist()}
        for i, matrix in reversed(list(enumerate(poses or matrices())))
    ]
    (root / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    for i in range(COUNT):
        cv2.imwrite(str(root / "images" / f"{i:04d}.png"), np.full((HEIGHT, WIDTH, 3), i, np.uint8))


def project(scene: Scene, index: int) -> np.ndarray:
    point = torch.from_numpy(POINT) - scene.offset
    return np.asarray(scene.train.camera(index).project(point.float()[None, None])[0, 0])


def test_frames_are_split_by_name_and_keep_their_own_cameras(tmp_path: Path) -> None:
    write(tmp_path)
    scene = load_scene(tmp_path)
    assert scene.test.names == ("images/0000.png", "images/0008.png")
    for k, name in enumerate(scene.train.names):
        i = int(name[7:11])
        assert round(float(scene.train.images[k].mean()) * 255) == i
        np.testing.assert_allclose(project(scene, k), pixel_of(matrices()[i]) - 0.5, atol=1e-4)
    assert scene.init_kind == "none"
    with pytest.raises(DataError, match="model-points"):
        load_scene(tmp_path, points="model-points")


@pytest.mark.parametrize("downscale", [None, 2])
def test_a_dot_is_where_the_camera_sees_its_point(tmp_path: Path, downscale: int | None) -> None:
    step, (column, row), poses = downscale or 1, (9, 6), matrices()
    depth = -np.linalg.solve(poses[1], [*POINT, 1])[2]
    shift = (pixel_of(poses[1]) - step * (np.array([column, row]) + 0.5)) / (50.0, 52.0) * depth
    poses[1][:3, 3] += shift[0] * poses[1][:3, 0] - shift[1] * poses[1][:3, 1]
    write(tmp_path, poses=poses)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[row * step : (row + 1) * step, column * step : (column + 1) * step] = 255
    cv2.imwrite(str(tmp_path / "images" / "0001.png"), image)
    scene = load_scene(tmp_path, downscale=downscale)
    assert torch.nonzero(scene.train.images[0, 0] > 0.99).tolist() == [[row, column]]
    np.testing.assert_allclose(project(scene, 0), [column, row], atol=1e-4)


def test_a_frames_own_lens_comes_first(tmp_path: Path) -> None:
    write(tmp_path)
    path = tmp_path / "transforms.json"
    data = json.loads(path.read_text())
    data["frames"][-2].update(fl_x=70.0, cx=19.0)  # 0001.png
    path.write_text(json.dumps(data))
    cameras = load_scene(tmp_path).train.cameras
    assert (float(cameras.fx[0]), float(cameras.cx[0]), float(cameras.fy[0])) == (70.0, 18.5, 52.0)
    assert (float(cameras.fx[1]), float(cameras.cx[1])) == (50.0, 20.5)


def test_a_field_of_view_alone_is_enough(tmp_path: Path) -> None:
    write(tmp_path, {"camera_angle_x": 0.8})
    cameras = load_scene(tmp_path).train.cameras
    focal = WIDTH / 2 / math.tan(0.4)
    np.testing.assert_allclose(cameras.intrinsics[0, :2, :3], [[focal, 0.0, 19.5], [0.0, focal, 14.5]], rtol=1e-6)


def test_a_lens_for_larger_images_is_scaled(tmp_path: Path) -> None:
    write(tmp_path, {key: value if key == "camera_model" else 2 * value for key, value in LENS.items()})
    cameras = load_scene(tmp_path).train.cameras
    np.testing.assert_allclose(cameras.intrinsics[0, :2, :3], np.array([[50, 0, 20.5], [0, 52, 14]]))


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("OPENCV", {"k1": -0.1, "k2": 0.02, "p1": 0.004, "p2": -0.003, "k3": 0.01}),
        ("OPENCV_FISHEYE", {"k1": 0.03, "k2": -0.02, "k3": 0.01, "k4": 0.0}),
    ],
)
def test_distorted_lenses_become_pinholes(tmp_path: Path, model: str, distortion: dict[str, float]) -> None:
    """Ramps say where each pixel comes from; OpenCV's projection says where it should."""
    write(tmp_path, {**LENS, **distortion, "camera_model": model})
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    ramps = np.stack([np.zeros_like(rows), rows * 1000, columns * 1000], axis=2).astype(np.uint16)  # red: columns
    cv2.imwrite(str(tmp_path / "images" / "0001.png"), ramps)
    scene = load_scene(tmp_path)
    matrix = scene.train.cameras.intrinsics[0, :3, :3].double().numpy()
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=2).reshape(-1, 1, 3)
    rays = pixels @ np.linalg.inv(matrix).T
    given = np.array([[50, 0, 20.5], [0, 52, 14], [0, 0, 1]])
    order = ("k1", "k2", "k3", "k4") if "FISH" in model else ("k1", "k2", "p1", "p2", "k3")
    numbers = np.array([distortion[key] for key in order])
    project_points = cv2.fisheye.projectPoints if "FISH" in model else cv2.projectPoints
    expected = project_points(rays, np.zeros(3), np.zeros(3), given, numbers)[0].reshape(-1, 2)
    got = scene.train.images[0, :2].permute(1, 2, 0).reshape(-1, 2).numpy() * 65.535
    np.testing.assert_allclose(got, expected, atol=0.02)


def test_test_poses_never_reach_the_training_cameras(tmp_path: Path) -> None:
    write(tmp_path)
    before = load_scene(tmp_path)
    poses = matrices()
    poses[0], poses[8] = matrices(seed=5)[:2]
    write(tmp_path, poses=poses)
    after = load_scene(tmp_path)
    assert torch.equal(before.offset, after.offset)
    assert torch.equal(before.train.cameras.extrinsics, after.train.cameras.extrinsics)
    assert not torch.equal(before.test.cameras.extrinsics, after.test.cameras.extrinsics)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR cannot be read"),
        ({"camera_model": 3}, "camera_model.*text"),
        ({"fl_x": 0}, "focal length"),
        ({"fl_x": -5.0}, "focal length"),
        ({"fl_y": "50"}, "fl_y.*finite number"),
        ({"cx": None}, "cx.*got none"),
        ({"w": 40.5}, "whole numbers"),
        ({"w": 0}, "image size"),
        ({"w": 30, "h": 40}, "not a scaled version"),
        ({"k1": -4.0}, "distortion"),
        ({"k1": [0.1]}, "k1.*finite number"),
    ],
)
def test_wrong_lenses(tmp_path: Path, values: dict[str, Any], message: str) -> None:
    write(tmp_path, {**LENS, **values})
    with pytest.raises(DataError, match=message):
        load_scene(tmp_path)


def test_no_focal_length_and_no_field_of_view(tmp_path: Path) -> None:
    write(tmp_path, {"w": 40, "h": 30})
    with pytest.raises(DataError, match="camera_angle_x"):
        load_scene(tmp_path)


@pytest.mark.parametrize("name", ["../a.png", "/a.png", "images/../../a.png", "C:/a.png"])
def test_names_stay_in_the_folder(tmp_path: Path, name: str) -> None:
    write(tmp_path)
    path = tmp_path / "transforms.json"
    path.write_text(path.read_text().replace("./images/0003.png", name))
    with pytest.raises(DataError, match="inside the scene"):
        load_scene(tmp_path)


def test_real_scene(kgs_data: Path) -> None:
    scene = load_scene(kgs_data / "nerfstudio" / "fox", 12)
    assert len(scene.train) == 12
    assert len(scene.test) == 7
    assert scene.test.names[0] == "images/0001.jpg"
    assert scene.train.images.shape == (12, 3, 480, 270)
    assert float(scene.train.cameras.cx[0]) == pytest.approx(138.6395 - 0.5, abs=1e-4)
