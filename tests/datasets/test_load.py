"""`load_scene` tells the layouts apart, refuses what is none, and real scenes obey epipolar geometry."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from epipolar import sampson_distances
from refusals import refused
from tiny_scenes import write_blender, write_colmap, write_llff, write_nerfstudio

from kgs._support.errors import DataError
from kgs.datasets import load_scene

PHOTOS = ["0.jpg", "1.jpg", "2.jpg"]
WITHOUT_POSES = [
    ([], r"poses_bounds\.npy.*transforms_train\.json.*transforms\.json.*sparse/0"),
    (["notes.txt", "._IMG_1.HEIC"], r"expected a scene, got another folder: there is no poses_bounds\.npy"),
    (["IMG_1.HEIC", "b.avif"], "2 photos without camera poses"),
    (["walk.MP4"], "expected a scene, got another folder"),
    (PHOTOS, "3 photos without camera poses.*COLMAP"),
]
# the first of these that is there is read, and these are empty files
IN_ORDER = [
    (["poses_bounds.npy", "sparse/0/images.bin", "transforms.json"], r"poses_bounds\.npy"),
    (["sparse/0/images.bin", "transforms_train.json"], "cameras.bin or cameras.txt"),
    (["sparse/images.txt", "transforms.json"], "cameras.bin or cameras.txt"),
    (["transforms_train.json", "transforms.json"], r"transforms_train\.json"),
    (["transforms.json"], r"transforms\.json"),
    (
        ["images.txt", "cameras.txt", "photos/0.jpg"],
        "COLMAP model is not used: expected its photos beside it or in images/",
    ),
    *[
        ([*PHOTOS, other], rf"3 photos without camera poses.* hold cameras: {other}")
        for other in ("reconstruction.json", "transform_train.json", "scan.XML", "0.xmp", "cameras.csv", "cameras.json")
    ],
]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([f"{folder}/{name}" for name in names], said)
        for folder in (".", "images", "images_4")
        for names, said in WITHOUT_POSES
    ]
    + IN_ORDER,
)
def test_what_is_no_scene_is_named(tmp_path: Path, names: list[str], message: str) -> None:
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(DataError, match=message) as error:
        load_scene(tmp_path)
    assert "\n" not in str(error.value)


def test_a_folder_too_deep_or_too_high_is_told_where_the_scene_is(tmp_path: Path) -> None:
    scene = tmp_path / "data" / "my scene"
    write_colmap(scene)
    (tmp_path / "data" / "a folder before it").mkdir()
    (scene / "notes.txt").touch()
    for given in (tmp_path, scene.parent, *(scene / part for part in ("images", "sparse/0", "notes.txt"))):
        with pytest.raises(DataError, match="my scene is one: give that folder"):
            load_scene(given)
    write_nerfstudio(tmp_path / "other")
    (tmp_path / "other" / "transforms.json").rename(tmp_path / "other" / "a.json")
    for name, got in (("a.json", "a file"), ("nowhere", "none")):
        with refused(DataError, path=tmp_path / "other" / name, expected="a folder", got=got):
            load_scene(tmp_path / "other" / name)


def test_photos_of_several_sizes_are_told_in_their_own_pixels(tmp_path: Path) -> None:
    write_llff(tmp_path, size=(6, 4))
    cv2.imwrite(str(tmp_path / "images" / "2.png"), np.zeros((8, 12, 3), np.uint8))
    for downscale in (None, 2):
        with pytest.raises(DataError, match=r"2\.png: expected 6x4 pixels as the other images, got 12x8"):
            load_scene(tmp_path, downscale=downscale)


def test_cameras_of_another_layout_that_are_not_used_are_named(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "transforms.json").write_bytes(b"{}")
    (note,) = load_scene(tmp_path).notes
    assert "transforms.json" in note


@pytest.mark.parametrize("count", [0, 1])
def test_a_scene_needs_a_view_to_train_on_and_one_to_test_on(tmp_path: Path, count: int) -> None:
    write_llff(tmp_path, count)
    with refused(DataError, path=tmp_path, key="", got=str(count)):
        load_scene(tmp_path)


@pytest.mark.parametrize(("downscale", "size"), [(2, (2, 3)), (1.5, (3, 4)), (100, (1, 1)), (1, (4, 6))])
def test_sizes_are_rounded_and_never_empty(tmp_path: Path, downscale: float, size: tuple[int, int]) -> None:
    write_llff(tmp_path, size=(6, 4))
    scene = load_scene(tmp_path, downscale=downscale)
    assert tuple(scene.train.images.shape[-2:]) == tuple(scene.test.images.shape[-2:]) == size
    assert float(scene.train.cameras.cx[0]) == pytest.approx((size[1] - 1) / 2, abs=1e-6)


@pytest.mark.parametrize(
    ("downscale", "fine_pixels", "finer"), [(2, 10**6, (4, 6)), (4, 6, (2, 3)), (2, 6, None), (None, 10**6, None)]
)
def test_first_points_have_the_training_views_in_more_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, downscale: float | None, fine_pixels: int, finer: tuple | None
) -> None:
    monkeypatch.setattr("kgs.datasets.load._FINE_PIXELS", fine_pixels)
    write_llff(tmp_path, size=(6, 4))
    scene = load_scene(tmp_path, downscale=downscale)
    assert (scene.train_full_size and tuple(scene.train_full_size.images.shape[-2:])) == finer
    if scene.train_full_size is not None:
        assert scene.train_full_size.names == scene.train.names
        assert torch.equal(scene.train_full_size.cameras.extrinsics, scene.train.cameras.extrinsics)


@pytest.mark.parametrize(
    ("name", "train_views"),
    [
        ("llff/fern", 6),
        ("llff/flower", 6),
        ("colmap/trex", 9),
        ("nerfstudio/fox", 24),
        pytest.param("blender/lego", None, marks=pytest.mark.slow),
    ],
)
def test_matches_of_real_photos_lie_on_epipolar_lines(kgs_data: Path, name: str, train_views: int | None) -> None:
    """A wrong axis, a shifted pairing of images and poses or a wrong focal length gives tens of pixels."""
    views = load_scene(kgs_data / name, train_views).train
    centers = -(views.cameras.extrinsics[:, :3, :3].mT @ views.cameras.extrinsics[:, :3, 3:])[..., 0]
    axes = views.cameras.extrinsics[:, 2, :3]
    pairs = list(itertools.combinations(range(len(views)), 2))
    # two views side by side: the pair that looks the most alike
    apart = [float((centers[i] - centers[j]).norm() * (2 - axes[i] @ axes[j])) for i, j in pairs]
    first, second = pairs[int(torch.tensor(apart).argmin())]
    distances = sampson_distances(views, first, second, ratio=0.7)
    assert len(distances) >= 20
    assert float(distances.median()) < 0.5


@pytest.mark.parametrize(
    ("hold_out", "test"), [(None, ["0.png"]), (2, ["0.png", "2.png"]), (3, ["0.png"]), (8, ["0.png"]), (0, [])]
)
def test_what_is_held_out_is_a_choice(tmp_path: Path, hold_out: int | None, test: list[str]) -> None:
    write_colmap(tmp_path)
    scene = load_scene(tmp_path, hold_out=hold_out)
    assert list(scene.test.names) == test
    assert {*scene.train.names, *test} == {"0.png", "1.png", "2.png"}
    assert len(scene.train) + len(test) == 3
    assert scene.test.images.shape == (len(test), *scene.train.images.shape[1:])


def test_test_views_of_the_files_can_be_trained_on(tmp_path: Path) -> None:
    write_blender(tmp_path)
    given = load_scene(tmp_path)
    everything = load_scene(tmp_path, hold_out=0)
    assert len(everything.test) == 0
    assert set(everything.train.names) == {*given.train.names, *given.test.names}
    assert len(load_scene(tmp_path, 2, hold_out=0).train) == 2


@pytest.mark.parametrize(("scale", "is_refused"), [(0.0, False), (3e-9, True), (3e-8, False)])
def test_cameras_that_float32_cannot_tell_apart_are_refused(tmp_path: Path, scale: float, is_refused: bool) -> None:
    """But for those of a panorama, which are in one place."""
    write_llff(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    rows = np.load(path)
    rows[:, 3] *= scale
    np.save(path, rows)
    if is_refused:
        with refused(DataError, path=tmp_path, key="poses"):
            load_scene(tmp_path)
    else:
        assert len(load_scene(tmp_path, hold_out=0).train) == 3
