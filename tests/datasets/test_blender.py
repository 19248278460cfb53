"""The Blender loader, on scenes written here by hand and on the real one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from kgs._support.errors import DataError
from kgs.datasets import load_scene

WIDTH, HEIGHT, ANGLE = 40, 30, 0.7


def write(root: Path, train: int = 6, test: int = 3) -> None:
    for split, count in (("train", train), ("test", test)):
        (root / split).mkdir()
        frames = []
        for i in range(count):
            matrix = np.eye(4)
            matrix[:3, 3] = i, 0, 4
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix.tolist()})
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": ANGLE, "frames": frames}))
        for i in range(count):
            cv2.imwrite(str(root / split / f"r_{i}.png"), np.full((HEIGHT, WIDTH, 4), 255, np.uint8))


def test_images_lie_on_the_background_and_alpha_is_the_mask(tmp_path: Path) -> None:
    write(tmp_path)
    cv2.imwrite(str(tmp_path / "train" / "r_1.png"), np.full((HEIGHT, WIDTH, 4), (0, 100, 200, 51), np.uint8))
    for name, behind in (("black", 0.0), ("white", 0.8)):
        scene = load_scene(tmp_path, background=name)
        expected = torch.tensor([200, 100, 0]) / 255 * 0.2 + behind
        torch.testing.assert_close(scene.train.images[1, :, 5, 5], expected)
        assert scene.background.tolist() == [behind / 0.8 if behind else 0.0] * 3
        assert scene.train.alphas is not None
        assert float(scene.train.alphas[1].mean()) == pytest.approx(0.2)
        assert float(scene.train.alphas[0].min()) == 1.0


def test_reducing_mixes_colours_in_proportion_to_alpha(tmp_path: Path) -> None:
    """A transparent pixel's own colour must not bleed into its neighbours."""
    write(tmp_path)
    image = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    image[..., :3] = (0, 255, 0)  # invisible green
    image[:, ::2] = (0, 0, 255, 255)  # red
    cv2.imwrite(str(tmp_path / "train" / "r_1.png"), image)
    scene = load_scene(tmp_path, downscale=2, background="white")
    torch.testing.assert_close(scene.train.images[1, :, 3, 3], torch.tensor([1.0, 0.5, 0.5]))


@pytest.mark.parametrize(
    ("count", "views", "expected"),
    [(100, 8, (2, 16, 26, 55, 73, 76, 86, 93)), (100, 3, (0, 50, 99)), (15, 8, range(0, 15, 2))],
)
def test_eight_of_many_frames_are_the_published_ones(
    tmp_path: Path, count: int, views: int, expected: Sequence[int]
) -> None:
    write(tmp_path, train=count, test=2)
    assert load_scene(tmp_path, views).train.names == tuple(f"train/r_{i}.png" for i in expected)


def test_first_points_are_random_in_the_cube_and_the_same_each_time(tmp_path: Path) -> None:
    write(tmp_path)
    scene, again = load_scene(tmp_path), load_scene(tmp_path)
    assert scene.init_kind == "random"
    assert torch.equal(scene.points, again.points)
    world = scene.points.double() + scene.offset
    assert world.shape == (10_000, 3)
    assert 0.99 < float(world.abs().max()) <= 1 + 1e-6
    assert float(world.mean(dim=0).abs().max()) < 0.03
    assert float((scene.point_colors - 0.5).abs().max()) <= 0.1


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"camera_angle_x": 3.2}, "camera_angle_x.*between 0 and pi"),
        ({"camera_angle_x": "wide"}, "camera_angle_x.*finite number"),
        ({"camera_angle_x": None}, "camera_angle_x.*got none"),
        ({"camera_angle_x": True}, "camera_angle_x.*finite number"),
        ({"file_path": "../../etc/passwd"}, "inside the scene"),
        ({"file_path": 7}, "file_path.*text"),
        ({"file_path": "train/r_1"}, "r_1.png.*several times"),
        ({"file_path": "train/r_77"}, r"1 of 9 images are missing: train/r_77\.png"),
        ({"transform_matrix": [[1, 0], [0, 1]]}, "4x4"),
        ({"transform_matrix": None}, "4x4"),
        ({"transform_matrix": np.diag([1, 1, 1, 2]).tolist()}, "last row"),
        ({"transform_matrix": np.diag([1.01, 1.01, 1.01, 1]).tolist()}, r"r_2\.png.*rotation"),
        ({"transform_matrix": [[10**400, 0, 0, 0], *np.eye(4).tolist()[1:]]}, "4x4 matrix of finite"),
    ],
)
def test_wrong_fields(tmp_path: Path, values: dict[str, Any], message: str) -> None:
    write(tmp_path)
    path = tmp_path / "transforms_train.json"
    data = json.loads(path.read_text())
    (data if "camera_angle_x" in values else data["frames"][2]).update(values)
    path.write_text(json.dumps(data))
    with pytest.raises(DataError, match=message):
        load_scene(tmp_path)


def test_the_last_row_of_an_inverse_is_that_of_a_pose(tmp_path: Path) -> None:
    write(tmp_path)
    exact = load_scene(tmp_path).train.cameras.extrinsics
    path = tmp_path / "transforms_train.json"
    data = json.loads(path.read_text())
    for frame in data["frames"]:
        frame["transform_matrix"][3] = [1e-8, 0.0, -3.3e-17, 0.9999999999999999]
    path.write_text(json.dumps(data))
    assert torch.equal(load_scene(tmp_path).train.cameras.extrinsics, exact)


NO_OBJECTS = ["", "{", "[]", "{}", '{"frames": []}', '{"frames": [3]}', "[" * 100_000, "\xff"]
NO_NUMBERS = ['{"camera_angle_x": NaN}', '{"camera_angle_x": 1e400}']


@pytest.mark.parametrize("text", NO_OBJECTS + NO_NUMBERS)
def test_files_that_are_no_transforms(tmp_path: Path, text: str) -> None:
    write(tmp_path)
    (tmp_path / "transforms_train.json").write_text(text, encoding="latin-1")
    with pytest.raises(DataError, match="transforms_train"):
        load_scene(tmp_path)


@pytest.mark.parametrize("poses", [True, False])
def test_without_test_pictures_the_training_file_is_split(tmp_path: Path, poses: bool) -> None:
    """BlenderNeRF writes test poses without pictures, or no test file."""
    write(tmp_path, train=9)
    shutil.rmtree(tmp_path / "test")
    if not poses:
        (tmp_path / "transforms_test.json").unlink()
    scene = load_scene(tmp_path, hold_out=4)
    assert scene.test.names == tuple(f"train/r_{i}.png" for i in (0, 4, 8))
    assert scene.train.names == tuple(f"train/r_{i}.png" for i in (1, 2, 3, 5, 6, 7))
    (note,) = scene.notes
    assert "transforms_test.json" in note
    assert load_scene(tmp_path).test.names == ("train/r_0.png", "train/r_8.png")
    assert len(load_scene(tmp_path, hold_out=0).train) == 9


def test_test_poses_without_a_picture_are_left_out(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "test" / "r_1.png").unlink()
    scene = load_scene(tmp_path)
    assert scene.test.names == ("test/r_0.png", "test/r_2.png")
    (note,) = scene.notes
    assert "1 of 3 poses" in note
