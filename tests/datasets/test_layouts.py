"""What holds in every layout: whose photo has which camera, where a point is seen, and what test views may say."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from posed_scenes import COUNT, HEIGHT, LAYOUTS, TEST, WIDTH, WORLD_POINT, moved, pixel_of, poses
from refusals import refused

from kgs._support.errors import DataError
from kgs.datasets import Scene, Views, load_scene

EACH = pytest.mark.parametrize("layout", LAYOUTS)


def project(scene: Scene, views: Views, index: int) -> np.ndarray:
    """Where Kornia's camera sees `WORLD_POINT`."""
    point = torch.from_numpy(WORLD_POINT) - scene.offset
    return np.asarray(views.camera(index).project(point.float()[None, None])[0, 0])


def number(name: str) -> int:
    return int(Path(name).stem[3:])


@EACH
def test_each_photo_has_its_own_camera(tmp_path: Path, layout: str) -> None:
    write, lens = LAYOUTS[layout]
    write(tmp_path, poses())
    scene = load_scene(tmp_path)
    assert [number(name) for name in scene.train.names] == [i for i in range(COUNT) if i not in TEST]
    assert [number(name) for name in scene.test.names] == [*TEST]
    for views in (scene.train, scene.test):
        for row, name in enumerate(views.names):
            rotation, translation = poses()[number(name)]
            assert round(float(views.images[row].max()) * 255) == number(name)
            np.testing.assert_allclose(views.cameras.extrinsics[row, :3, :3], rotation, atol=1e-6)
            recentred = translation + rotation @ scene.offset.numpy()
            np.testing.assert_allclose(views.cameras.extrinsics[row, :3, 3], recentred, atol=1e-5)
            expected = pixel_of((rotation, translation), lens) - 0.5
            np.testing.assert_allclose(project(scene, views, row), expected, atol=1e-4)
    fx, fy, cx, cy = lens
    matrix = [[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5]]
    np.testing.assert_allclose(scene.train.cameras.intrinsics[0, :2, :3], matrix, rtol=1e-6)
    assert scene.init_kind == ("random" if layout == "Blender" else "none")
    assert len(scene.points) == (10_000 if layout == "Blender" else 0)


@EACH
@pytest.mark.parametrize("downscale", [None, 2])
def test_convention_a_dot_is_where_a_camera_sees_its_point(tmp_path: Path, layout: str, downscale: int | None) -> None:
    """The half pixel: a dot is drawn where the format puts the point, and found where Kornia's camera puts it."""
    write, lens = LAYOUTS[layout]
    step = downscale or 1
    column, row = 9, 6  # of the photo that is loaded
    given = poses()
    given[1] = moved(given[1], lens, step * (np.array([column, row]) + 0.5))
    write(tmp_path, given)
    (path,) = tmp_path.rglob("img1.png")
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[row * step : (row + 1) * step, column * step : (column + 1) * step] = 255
    cv2.imwrite(str(path), image)
    scene = load_scene(tmp_path, downscale=downscale)
    assert torch.nonzero(scene.train.images[0, 0] > 0.99).tolist() == [[row, column]]
    np.testing.assert_allclose(project(scene, scene.train, 0), [column, row], atol=1e-4)


@EACH
def test_test_views_never_reach_the_training_views(tmp_path: Path, layout: str) -> None:
    write, _ = LAYOUTS[layout]
    points = "model-points" if "COLMAP" in layout else "none"
    write(tmp_path / "a", poses())
    others = poses()
    for i in TEST:
        others[i] = poses(seed=5)[i]
    write(tmp_path / "b", others)
    for i in TEST:
        (path,) = (tmp_path / "b").rglob(f"img{i}.png")
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), 200, np.uint8))
    before, after = (load_scene(tmp_path / folder, points=points) for folder in "ab")
    assert not torch.equal(before.test.cameras.extrinsics, after.test.cameras.extrinsics)
    assert torch.equal(before.offset, after.offset)
    assert torch.equal(before.train.cameras.extrinsics, after.train.cameras.extrinsics)
    assert torch.equal(before.train.images, after.train.images)
    assert torch.equal(before.points, after.points)


@pytest.mark.parametrize("layout", ["LLFF", "Blender", "nerfstudio"])
def test_model_points_need_a_model(tmp_path: Path, layout: str) -> None:
    write, _ = LAYOUTS[layout]
    write(tmp_path, poses())
    with refused(DataError, path=tmp_path, key="points"):
        load_scene(tmp_path, points="model-points")


REAL = [
    # train_views, the first training and test view, how many of these, size, fx, cx
    ("llff/fern", 3, "image001.png", "image000.png", 3, (378, 504), None, 251.5),
    ("llff/flower", 3, "image001.png", "image000.png", 5, (378, 504), None, 251.5),
    ("colmap/trex", 3, "img002.jpg", "img001.jpg", 7, (375, 501), None, 250.82686 - 0.5),
    ("nerfstudio/fox", 12, None, "images/0001.jpg", 7, (480, 270), None, 138.6395 - 0.5),
    ("blender/lego", 8, "train/r_2.png", None, 25, (400, 400), 1111.11 / 2, 199.5),  # the well-known focal at 800
]


@pytest.mark.parametrize(("name", "count", "train", "test", "tests", "size", "fx", "cx"), REAL)
def test_real_scenes(kgs_data: Path, name: str, count: int, train, test, tests: int, size, fx, cx: float) -> None:
    has_model = name.startswith(("llff", "colmap"))
    scene = load_scene(kgs_data / name, count, points="model-points" if has_model else "none")
    assert scene.train.images.shape == (count, 3, *size)
    assert len(scene.test) == tests
    assert scene.train.names[0] == (train or scene.train.names[0])
    assert scene.test.names[0] == (test or scene.test.names[0])
    assert float(scene.train.cameras.cx[0]) == pytest.approx(cx, abs=1e-4)
    assert fx is None or float(scene.train.cameras.fx[0]) == pytest.approx(fx, abs=0.01)
    if has_model:  # its points are before the training cameras and most of them inside their photos
        pixels = scene.train.camera(1).project(scene.points[None])[0]
        inside = ((pixels > 0) & (pixels < torch.tensor([size[1] - 1.0, size[0] - 1.0]))).all(dim=1)
        assert len(scene.points) > 200
        assert inside.float().mean() > 0.7
