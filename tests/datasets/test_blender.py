"""The Blender layout: transparency, the published views, initial points, and test views."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny_scenes import update_json, write_blender

from kgs.datasets import load_scene

SIZE = (12, 16)


def test_images_lie_on_the_background_and_alpha_is_the_mask(tmp_path: Path) -> None:
    write_blender(tmp_path)
    cv2.imwrite(str(tmp_path / "train" / "0.png"), np.zeros((*SIZE, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "train" / "1.png"), np.full((*SIZE, 4), (0, 100, 200, 51), np.uint8))
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
    write_blender(tmp_path)
    image = np.zeros((*SIZE, 4), np.uint8)
    image[..., :3] = (0, 255, 0)  # invisible green
    image[:, ::2] = (0, 0, 255, 255)  # red
    cv2.imwrite(str(tmp_path / "train" / "1.png"), image)
    scene = load_scene(tmp_path, downscale=2, background="white")
    torch.testing.assert_close(scene.train.images[1, :, 3, 3], torch.tensor([1.0, 0.5, 0.5]))


@pytest.mark.parametrize(
    ("count", "views", "expected"),
    [(100, 8, (2, 16, 26, 55, 73, 76, 86, 93)), (100, 3, (0, 50, 99)), (15, 8, range(0, 15, 2))],
)
def test_eight_of_many_frames_are_the_published_ones(
    tmp_path: Path, count: int, views: int, expected: Sequence[int]
) -> None:
    write_blender(tmp_path, train=count, test=2)
    assert load_scene(tmp_path, views).train.names == tuple(f"train/{i}.png" for i in expected)


def test_first_points_are_random_in_the_cube_and_the_same_each_time(tmp_path: Path) -> None:
    write_blender(tmp_path)
    scene, again = load_scene(tmp_path), load_scene(tmp_path)
    assert scene.init_kind == "random"
    assert torch.equal(scene.points, again.points)
    world = scene.points.double() + scene.offset
    assert world.shape == (10_000, 3)
    assert 0.99 < float(world.abs().max()) <= 1 + 1e-6
    assert float(world.mean(dim=0).abs().max()) < 0.03
    assert float((scene.point_colors - 0.5).abs().max()) <= 0.1


def test_the_last_row_of_an_inverse_is_that_of_a_pose(tmp_path: Path) -> None:
    write_blender(tmp_path)
    exact = load_scene(tmp_path).train.cameras.extrinsics
    rows = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [1e-8, 0.0, -3.3e-17, 0.9999999999999999]]
    update_json(tmp_path / "transforms_train.json", 0, transform_matrix=rows)
    assert torch.equal(load_scene(tmp_path).train.cameras.extrinsics, exact)


@pytest.mark.parametrize("poses", [True, False])
def test_without_test_pictures_the_training_file_is_split(tmp_path: Path, poses: bool) -> None:
    """BlenderNeRF writes test poses without pictures, or no test file."""
    write_blender(tmp_path, train=9)
    shutil.rmtree(tmp_path / "test")
    if not poses:
        (tmp_path / "transforms_test.json").unlink()
    scene = load_scene(tmp_path, hold_out=4)
    assert scene.test.names == tuple(f"train/{i}.png" for i in (0, 4, 8))
    assert scene.train.names == tuple(f"train/{i}.png" for i in (1, 2, 3, 5, 6, 7))
    (note,) = scene.notes
    assert "transforms_test.json" in note
    assert load_scene(tmp_path).test.names == ("train/0.png", "train/8.png")
    assert len(load_scene(tmp_path, hold_out=0).train) == 9


def test_test_poses_without_a_picture_are_left_out(tmp_path: Path) -> None:
    write_blender(tmp_path)
    (tmp_path / "test" / "1.png").unlink()
    scene = load_scene(tmp_path)
    assert scene.test.names == ("test/0.png", "test/2.png")
    (note,) = scene.notes
    assert "1 of 3 poses" in note
