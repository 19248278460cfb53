"""The COLMAP loader, on models that pycolmap wrote."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from posed_scenes import COUNT, HEIGHT, WIDTH, WORLD_POINT, write_colmap
from refusals import refused

from kgs._support.errors import DataError
from kgs.datasets import load_scene

DISTORTED = [
    ("SIMPLE_RADIAL", [40.0, 24.3, 15.6, -0.1]),
    ("RADIAL", [40.0, 24.3, 15.6, -0.1, 0.02]),
    ("OPENCV", [40.0, 42.0, 24.3, 15.6, -0.1, 0.02, 0.003, -0.002]),
    ("FULL_OPENCV", [40.0, 42.0, 24.3, 15.6, -0.1, 0.02, 0.003, -0.002, 0.01, 0.02, 0.01, 0.0]),
    ("OPENCV_FISHEYE", [40.0, 42.0, 24.3, 15.6, 0.02, -0.01, 0.003, 0.001]),
    ("SIMPLE_RADIAL_FISHEYE", [40.0, 24.3, 15.6, 0.02]),
    ("RADIAL_FISHEYE", [40.0, 24.3, 15.6, 0.02, -0.01]),
    ("OPENCV", [40.0, 42.0, 24.3, 15.6, 0.15, 0.02, 0.004, -0.006]),
    ("OPENCV_FISHEYE", [40.0, 42.0, 24.3, 15.6, 0.0, 0.0, 0.0, 0.0]),
    ("SIMPLE_FISHEYE", [40.0, 24.3, 15.6]),
    ("FISHEYE", [40.0, 42.0, 24.3, 15.6]),
    ("FISHEYE", [18.0, 17.0, 25.0, 17.0]),
]


@pytest.mark.parametrize("text", [False, True])
def test_model_points_need_two_training_images(tmp_path: Path, text: bool) -> None:
    write_colmap(tmp_path, text=text)
    scene = load_scene(tmp_path, points="model-points")  # 8 is a test image: the second point has one view left
    assert scene.init_kind == "model-points"
    np.testing.assert_allclose((scene.points.double() + scene.offset).numpy(), [WORLD_POINT], atol=1e-5)
    np.testing.assert_allclose(scene.point_colors, [[1.0, 0.0, 0.2]], atol=1e-6)
    assert load_scene(tmp_path, 6).train.names == tuple(f"img{i}.png" for i in (1, 2, 4, 5, 7, 9))
    assert len(load_scene(tmp_path, 6, points="model-points").points) == 1
    assert load_scene(tmp_path, 3).train.names == ("img1.png", "img5.png", "img9.png")
    assert len(load_scene(tmp_path, 3, points="model-points").points) == 0


@pytest.mark.parametrize(("model", "params"), DISTORTED)
def test_convention_lenses_are_those_of_colmap(tmp_path: Path, model: str, params: list[float]) -> None:
    """Ramps say where each pixel comes from; pycolmap's own projection says where it should."""
    pycolmap = pytest.importorskip("pycolmap")
    write_colmap(tmp_path, model=model, params=params)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    ramps = np.stack([np.zeros_like(rows), rows * 1000, columns * 1000], axis=2).astype(np.uint16)  # red: columns
    cv2.imwrite(str(tmp_path / "images" / "img1.png"), ramps)
    scene = load_scene(tmp_path)
    matrix = scene.train.cameras.intrinsics[0, :3, :3].double()
    pixels = torch.from_numpy(np.stack([columns, rows, np.ones_like(rows)], axis=2).reshape(-1, 3)).double()
    camera = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)
    expected = camera.img_from_cam((pixels @ torch.linalg.inv(matrix).T).numpy()) - 0.5
    got = scene.train.images[0, :2].permute(1, 2, 0).reshape(-1, 2).numpy() * 65.535
    np.testing.assert_allclose(got, expected, atol=0.02)


def test_several_lenses_and_names_with_spaces_and_folders(tmp_path: Path) -> None:
    names = [f"cam {i % 2}/img {i}.png" for i in range(COUNT)]
    write_colmap(tmp_path, text=True, names=names)
    cameras = tmp_path / "sparse" / "0" / "cameras.txt"
    cameras.write_text(cameras.read_text() + f"9 SIMPLE_PINHOLE {WIDTH} {HEIGHT} 55 20 10\n")
    images = tmp_path / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace(" 7 cam 1/", " 9 cam 1/"))
    images.with_stem("frames").unlink()  # which would have the other camera
    scene = load_scene(tmp_path)
    focal = dict(zip(scene.train.names, scene.train.cameras.fx.tolist(), strict=True))
    assert focal["cam 1/img 3.png"] == 55
    assert focal["cam 0/img 4.png"] == 40
    assert float(scene.train.cameras.cx[-1]) == 19.5


def test_intrinsics_follow_the_size_of_the_images(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    for path in (tmp_path / "images").iterdir():
        cv2.imwrite(str(path), np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8))
    scene = load_scene(tmp_path)
    assert float(scene.train.cameras.fx[0]) == 20.0
    assert float(scene.train.cameras.cx[0]) == WIDTH / 4 - 0.5


@pytest.mark.parametrize("small", ["0", "1"])
def test_of_several_models_the_one_with_most_images_is_read(tmp_path: Path, small: str) -> None:
    write_colmap(tmp_path, text=True)
    (tmp_path / "sparse" / "0").rename(tmp_path / "sparse" / str(1 - int(small)))
    shutil.copytree(tmp_path / "sparse" / str(1 - int(small)), tmp_path / "sparse" / small)
    images = tmp_path / "sparse" / small / "images.txt"
    lines = images.read_text().split("\n")
    begin = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    images.write_text("\n".join(lines[: begin + 4]) + "\n")  # two lines an image
    scene = load_scene(tmp_path, points="model-points")
    assert len(scene.train) + len(scene.test) == COUNT
    assert len(scene.points) == 1
    (note,) = scene.notes
    assert f"sparse/{1 - int(small)} " in note
    assert f"sparse/{small} has 2" in note


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("text", [False, True])
def test_a_model_beside_its_photos_or_their_folder(tmp_path: Path, text: bool, beside: bool) -> None:
    """As RealityScan exports it."""
    write_colmap(tmp_path, text=text)
    before = load_scene(tmp_path, points="model-points")
    for path in [*(tmp_path / "sparse" / "0").iterdir(), *((tmp_path / "images").iterdir() if beside else [])]:
        path.rename(tmp_path / path.name)
    shutil.rmtree(tmp_path / "sparse")
    if beside:
        (tmp_path / "images").rmdir()
    after = load_scene(tmp_path, points="model-points")
    assert after.notes == ()
    for part, other in ((before.train, after.train), (before.test, after.test)):
        assert part.names == other.names
        assert torch.equal(part.images, other.images)
        assert torch.equal(part.cameras.extrinsics, other.cameras.extrinsics)
    assert torch.equal(before.points, after.points)


def test_photos_that_are_gone_are_left_out_and_named(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    cv2.imwrite(str(tmp_path / "images" / "aaa.png"), np.zeros((5, 5, 3), np.uint8))  # one that the model lacks
    before = load_scene(tmp_path)
    assert len(before.train) + len(before.test) == COUNT
    gone = {"img2.png", "img5.png"}
    for name in gone:
        (tmp_path / "images" / name).unlink()
    scene = load_scene(tmp_path, points="model-points")
    assert {*scene.train.names, *scene.test.names} == {*before.train.names, *before.test.names} - gone
    (note,) = scene.notes
    assert "2 of 10" in note
    assert all(name in note for name in gone)


@pytest.mark.parametrize("name", ["sparse/0/test.txt", "sparse/0/test_list.txt", "test_list.txt"])
def test_a_list_names_the_test_views(tmp_path: Path, name: str) -> None:
    """Unless the user says which are held out."""
    write_colmap(tmp_path)
    (tmp_path / name).write_bytes(b"\xef\xbb\xbfimg4.png\r\nimg2.png\r\n\r\nimg77.png\r\n")
    scene = load_scene(tmp_path, 3)
    assert scene.test.names == ("img2.png", "img4.png")
    assert scene.train.names == ("img0.png", "img6.png", "img9.png")
    (note,) = scene.notes
    assert "img77.png" in note
    assert load_scene(tmp_path, hold_out=2).test.names == tuple(f"img{i}.png" for i in range(0, COUNT, 2))


@pytest.mark.parametrize("named", [range(0), range(COUNT)])
def test_a_list_that_leaves_no_test_or_training_view_is_not_used(tmp_path: Path, named: range) -> None:
    write_colmap(tmp_path)
    expected = load_scene(tmp_path).test.names
    (tmp_path / "test_list.txt").write_text("\n".join(f"img{i}.png" for i in named))
    scene = load_scene(tmp_path)
    assert scene.test.names == expected
    (note,) = scene.notes
    assert f"not used: it names {len(named)} of {COUNT}" in note


@pytest.mark.parametrize("change", ["backslashes", "img3.PNG", "IMG3.png"])
def test_names_with_backslashes_or_in_another_case(tmp_path: Path, change: str) -> None:
    write_colmap(tmp_path, text=True, names=[f"cam/img{i}.png" for i in range(COUNT)])
    before = load_scene(tmp_path)
    images = tmp_path / "sparse" / "0" / "images.txt"
    if change == "backslashes":
        images.write_text(images.read_text().replace("cam/", "cam\\"))
    else:
        (tmp_path / "images" / "cam" / "img3.png").rename(tmp_path / "images" / "cam" / change)
    after = load_scene(tmp_path)
    assert before.notes == after.notes == ()
    assert [name[-8:] for name in after.train.names] == [name[-8:] for name in before.train.names]
    assert torch.equal(after.train.images, before.train.images)


@pytest.mark.parametrize("hold_out", [None, 0])
def test_a_model_without_photos_is_named(tmp_path: Path, hold_out: int | None) -> None:
    write_colmap(tmp_path, text=True)
    (tmp_path / "sparse" / "0" / "images.txt").write_text("# none\n")
    with refused(DataError, path=tmp_path, key=""):
        load_scene(tmp_path, hold_out=hold_out)
