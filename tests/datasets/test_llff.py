"""The LLFF loader, on arrays made here from the format's description."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from posed_scenes import WORLD_POINT, llff_rows, poses, write_colmap, write_rows
from refusals import refused

from kgs._support.errors import DataError
from kgs.datasets import load_scene
from kgs.fit import FitConfig
from kgs.fit.run import choose_points


def rows() -> np.ndarray:
    return llff_rows(poses())


def test_offset_is_the_mean_of_the_training_centres(tmp_path: Path) -> None:
    array = rows()
    write_rows(tmp_path, array)
    scene = load_scene(tmp_path, 3)
    np.testing.assert_allclose(scene.offset, array[[1, 5, 9]][:, [3, 8, 13]].mean(axis=0), rtol=1e-14)
    rotation, translation = scene.train.cameras.extrinsics.split((3, 1), dim=2)
    centers = -(rotation[:, :3].mT @ translation[:, :3])
    np.testing.assert_allclose(centers.mean(dim=0), np.zeros((3, 1)), atol=1e-6)


def test_far_from_the_origin_no_digit_is_lost(tmp_path: Path) -> None:
    array = rows()
    write_rows(tmp_path / "a", array)
    array[:, [3, 8, 13]] += [4e6, -5e5, 3e3]
    write_rows(tmp_path / "b", array)
    near, far = load_scene(tmp_path / "a"), load_scene(tmp_path / "b")
    torch.testing.assert_close(near.train.cameras.extrinsics, far.train.cameras.extrinsics, atol=1e-6, rtol=0)


@pytest.mark.parametrize("bounds", [(0.0, 0.0), (9.0, 1.0), (np.nan, np.inf)])
def test_depths_are_not_used_whatever_they_are(tmp_path: Path, bounds: tuple[float, float]) -> None:
    array = rows()
    write_rows(tmp_path, array)
    before = load_scene(tmp_path)
    array[:, 15:] = bounds
    np.save(tmp_path / "poses_bounds.npy", array)
    assert torch.equal(load_scene(tmp_path).train.cameras.extrinsics, before.train.cameras.extrinsics)


def test_model_points_need_the_same_poses(tmp_path: Path) -> None:
    """A model that has the poses of the rows gives its points; with one pose turned it is refused."""
    write_colmap(tmp_path, poses(), text=True, names=[f"IMG_{i}.JPG" for i in range(10)])
    shutil.rmtree(tmp_path / "images")
    write_rows(tmp_path, rows())
    scene = load_scene(tmp_path, points="model-points")
    assert scene.init_kind == "model-points"
    with refused(DataError, key="points"):
        choose_points(scene, FitConfig(init="scene"))  # they would be taken for points of the layout
    np.testing.assert_allclose((scene.points.double() + scene.offset).numpy(), [WORLD_POINT], atol=1e-5)
    path = tmp_path / "sparse" / "0" / "images.txt"
    path.write_text(re.sub(r"\n96 \S+ (\S+)", r"\n96 0.5 \1", path.read_text()))
    with refused(DataError, path=path.parent, key="points"):
        load_scene(tmp_path, points="model-points")
    assert load_scene(tmp_path).init_kind == "none"
