"""Depth maps of photos: found by name, read as they are, and resampled, undistorted and turned as their photos."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from refusals import refused
from tiny_scenes import write_colmap, write_llff, write_nerfstudio

from kgs._support.errors import DataError
from kgs.datasets import load_scene
from kgs.datasets.depths import find_depths, read_depths

RAMP = np.arange(1.0, 193.0).reshape(12, 16)  # as large as the photos
SIZE = (16, 12)
Write = Callable[[Path], None]


def write_map(path: Path, values: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, values)
    else:
        cv2.imwrite(str(path), values)
    return path


@pytest.mark.parametrize(
    ("suffix", "values"),
    [
        (".npy", RAMP),
        (".npy", RAMP.astype(np.float16)[None]),
        (".npy", RAMP.astype(np.int64)),
        (".png", RAMP.astype(np.uint16)),
        (".png", RAMP.astype(np.uint8)),
        (".png", np.repeat(RAMP.astype(np.uint8)[..., None], 3, 2)),
        (".tif", RAMP.astype(np.float32)),
        (".tiff", RAMP.astype(np.uint16)),
    ],
)
def test_a_map_is_read_as_it_is(tmp_path: Path, suffix: str, values: np.ndarray) -> None:
    read = read_depths(write_map(tmp_path / f"a{suffix}", values), Path("a.jpg"), *SIZE)
    assert read.dtype == np.float32
    assert np.array_equal(read, RAMP)


def test_a_map_of_another_size_keeps_its_values(tmp_path: Path) -> None:
    values = RAMP.copy()
    values[0, 0], values[5, 5], values[5, 6] = np.nan, np.inf, -np.inf
    path = write_map(tmp_path / "a.npy", values)
    assert set(read_depths(path, Path("a.jpg"), 8, 6).ravel()) < {0.0, *RAMP.ravel()}
    doubled = read_depths(path, Path("a.jpg"), 32, 24)
    known = np.where(np.isfinite(values), values, 0.0)
    assert np.array_equal(doubled, np.repeat(np.repeat(known, 2, 0), 2, 1))
    network = write_map(tmp_path / "b.npy", np.ones((392, 518)))  # sides of 14 pixels, for a photo of 4:3
    assert read_depths(network, Path("b.jpg"), 4032, 3024).shape == (3024, 4032)


def pickled(path: Path) -> None:
    np.save(path, np.array([{}]), allow_pickle=True)


def of(values: np.ndarray) -> Write:
    return lambda path: write_map(path, values) and None


@pytest.mark.parametrize(
    ("name", "write", "got"),
    [
        ("a.npy", of(RAMP.T), "12x16"),
        ("a.npy", of(RAMP[:, :12]), "12x12"),
        ("a.npy", of(RAMP.astype(complex)), "complex128 (12, 16)"),
        ("a.npy", of(np.array(1.0)), "float64 ()"),
        ("a.png", of(np.dstack([RAMP, RAMP, RAMP + 1]).astype(np.uint8)), "uint8 (12, 16, 3)"),
        ("a.npy", of(np.zeros((0, 16))), "16x0"),
        ("a.npy", pickled, "a damaged file"),
        ("a.npy", lambda path: path.write_bytes(b"\x93NUMPY"), "a damaged file"),
        ("a.png", lambda path: path.write_bytes(b"\x89PNG"), "a damaged file"),
        ("a.tif", lambda path: path.write_bytes(b""), "a damaged file"),
    ],
)
def test_maps_that_are_refused(tmp_path: Path, name: str, write: Write, got: str) -> None:
    write(tmp_path / name)
    with refused(DataError, path=tmp_path / name, key="", got=got):
        read_depths(tmp_path / name, Path("a.jpg"), *SIZE)


PHOTOS = [Path("scene/images/IMG_0.jpg"), Path("scene/images/IMG_1.jpg"), Path("scene/images/cam/IMG_1.jpg")]


def test_maps_are_found_by_the_names_of_photos(tmp_path: Path) -> None:
    names = ("IMG_0.npy", "img_1.JPG.png", ".IMG_1.npy", "IMG_0.txt", "cam/IMG_1.tiff", "IMG_9.npy")
    files = [write_map(tmp_path / "none.npy", RAMP).rename(tmp_path / name) for name in names[:4]]
    assert find_depths(PHOTOS[:2], tmp_path) == dict(zip(PHOTOS, files[:2], strict=False))
    inner = write_map(tmp_path / "inner" / "cam" / "IMG_1.npy", RAMP)
    assert find_depths(PHOTOS, inner.parents[1]) == {PHOTOS[2]: inner}


@pytest.mark.parametrize(
    ("files", "wrong"),
    [
        (None, "."),
        ((), "."),
        (("IMG_9.npy", "IMG_0.exr"), "."),
        (("IMG_0.npy", "IMG_0.png"), "IMG_0.png"),
        (("IMG_1.npy",), "IMG_1.npy"),  # of which of two photos?
    ],
)
def test_folders_that_are_refused(tmp_path: Path, files: tuple[str, ...] | None, wrong: str) -> None:
    folder = tmp_path / "depths"
    if files is not None:
        folder.mkdir()
        for name in files:
            (folder / name).touch()
    with refused(DataError, path=folder / wrong, key=""):
        find_depths(PHOTOS, folder)


def test_only_training_views_have_depths(tmp_path: Path) -> None:
    write_llff(tmp_path, 9)
    depths = tmp_path / "depths"
    for k in (0, 1, 4, 8):  # 0 and 8 are for testing
        write_map(depths / f"{k}.npy", RAMP + k)
    scene = load_scene(tmp_path, depths=depths, downscale=2)
    assert scene.test.depths is None
    assert scene.train_full_size is not None
    for views, expected in ((scene.train, RAMP[1::2, 1::2]), (scene.train_full_size, RAMP)):
        assert views.depths is not None
        assert views.depths.dtype == torch.float32
        assert np.array_equal(views.depths[0], expected + 1)
        assert [bool(values.any()) for values in views.depths] == [True, False, False, True, False, False, False]
    assert any(note.startswith("training photos without a depth map: 5 ") for note in scene.notes)
    few = load_scene(tmp_path, 1, depths=depths)
    assert not any("depth map" in note for note in few.notes)
    assert load_scene(tmp_path).train.depths is None
    assert load_scene(tmp_path, photos=False, depths=depths).train.depths is None


def test_depths_go_where_views_go(tmp_path: Path) -> None:
    write_llff(tmp_path)
    write_map(tmp_path / "depths" / "1.npy", RAMP)
    views = load_scene(tmp_path, hold_out=0, depths=tmp_path / "depths").train
    halved = views.downsample(2).select([2, 1])
    assert halved.depths is not None
    assert not halved.depths[0].any()
    assert np.array_equal(halved.depths[1], RAMP[1::2, 1::2])
    third = views.downsample(5).depths
    assert third is not None
    assert np.array_equal(third[1], RAMP[2:12:5, 2:15:5])


@pytest.mark.parametrize("write", [write_colmap, write_nerfstudio])
def test_a_map_is_undistorted_as_its_photo(tmp_path: Path, write: Callable[[Path], None]) -> None:
    """A photo of the same ramp, in steps that its interpolation cannot hide, goes through the same lens."""
    write(tmp_path)
    steps = np.tile(np.arange(16) * 16, (12, 1))
    for k in range(3):
        cv2.imwrite(str(tmp_path / "images" / f"{k}.png"), np.repeat(steps[..., None].astype(np.uint8), 3, 2))
        write_map(tmp_path / "depths" / f"{k}.npy", steps + 1000.0)
    views = load_scene(tmp_path, hold_out=0, depths=tmp_path / "depths").train
    assert views.depths is not None
    assert set(views.depths.unique().tolist()) <= {0.0, *(steps.ravel() + 1000.0)}  # no values between
    known = views.depths > 0
    assert known.float().mean() > 0.9
    shown = views.images[:, 0] * 255
    assert bool(((shown - (views.depths - 1000.0))[known].abs() <= 8.01).all())  # half a step
    if write is write_nerfstudio:
        assert not torch.equal(views.depths[1], torch.from_numpy(steps + 1000.0).float())  # the lens bends


def test_an_error_of_a_map_names_it(tmp_path: Path) -> None:
    write_llff(tmp_path)
    path = write_map(tmp_path / "depths" / "1.npy", RAMP.T)
    with refused(DataError, path=path, expected="the shape of 1.png, 16x12", got="12x16"):
        load_scene(tmp_path, hold_out=0, depths=tmp_path / "depths")
