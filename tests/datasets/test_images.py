"""Reading, undistorting and reducing images, against OpenCV's projection and counting by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_scenes import read_image

from kgs.datasets.folders import image_folder, list_images
from kgs.datasets.images import Intrinsics, rectification, remap, resize

WIDTH, HEIGHT = 120, 90


def blob(x: float, y: float, sigma: float = 2.0) -> np.ndarray:
    """A Gaussian spot at (x, y), integer pixel centres, `(H, W, 1)`."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.asarray(np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2)), dtype=np.float32)


def centroid(image: np.ndarray) -> np.ndarray:
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(image * columns).sum() / image.sum(), (image * rows).sum() / image.sum()])


def lens(*distortion: float) -> Intrinsics:
    return Intrinsics(WIDTH, HEIGHT, 100.0, 98.0, 58.0, 47.0, distortion)


def undistort(image: np.ndarray, given: Intrinsics) -> tuple[np.ndarray, Intrinsics]:
    pinhole, maps = rectification(given)
    return remap(image, maps), pinhole


def test_convention_colours_come_as_rgb(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((2, 3, 3), (255, 51, 0), np.uint8))  # blue, green, red
    image = read_image(tmp_path / "a.png")
    assert image.shape == (2, 3, 3)
    assert image.dtype == np.float32
    np.testing.assert_array_equal(image[0, 0], np.array([0, 0.2, 1], np.float32))


def test_folders(tmp_path: Path) -> None:
    assert image_folder(tmp_path) is None
    for name in ("images_8", "images_4", "images_16", "images_old"):
        (tmp_path / name).mkdir()
    assert image_folder(tmp_path) == tmp_path / "images_4"
    (tmp_path / "images").mkdir()
    assert image_folder(tmp_path) == tmp_path / "images"
    for name in ("b.JPG", "a10.png", "a2.png", ".hidden.png", "notes.txt"):
        (tmp_path / "images" / name).touch()
    assert [p.name for p in list_images(tmp_path / "images")] == ["a10.png", "a2.png", "b.JPG"]


def test_reducing_takes_the_mean_and_scales_each_axis_by_its_exact_ratio() -> None:
    image = np.random.default_rng(0).random((HEIGHT, WIDTH, 3)).astype(np.float32)
    small, result = resize(image, lens(), WIDTH // 2, HEIGHT // 3)
    expected = image.reshape(HEIGHT // 3, 3, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(small, expected, atol=1e-6)
    assert (result.width, result.height, result.fx, result.fy) == (60, 30, 50.0, 98.0 / 3)
    # a point keeps its position: (u + 1/2) / W is the same in both images
    x, y = result.matrix()[:2, 2]
    np.testing.assert_allclose([(x + 0.5) / 60, (y + 0.5) / 30], [58 / WIDTH, 47 / HEIGHT])


def test_reducing_by_a_fraction_moves_a_spot_as_its_camera_says() -> None:
    small, result = resize(blob(50.0, 31.0, 4.0), lens(), 77, 58)
    ray = (np.array([50.0, 31.0]) - lens().matrix()[:2, 2]) / (100.0, 98.0)
    expected = ray * (result.fx, result.fy) + result.matrix()[:2, 2]
    np.testing.assert_allclose(centroid(small), expected, atol=2e-3)


def rays(pinhole: Intrinsics) -> np.ndarray:
    """The direction of each pixel, `(H * W, 3)`, z = 1."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=2).reshape(-1, 3)
    return np.asarray(pixels @ np.linalg.inv(pinhole.matrix()).T)


@pytest.mark.parametrize(
    ("k1", "fisheye"), [(-0.2, False), (0.0, False), (0.1, False), (0.3, False), (0.1, True), (0.6, True)]
)
def test_no_pixel_of_an_undistorted_image_is_blank_or_smeared(k1: float, fisheye: bool) -> None:
    """Every pixel of the result looks at a point inside the photo; barrel lenses keep their focal length."""
    given = replace(lens(k1, 0.0, 0.0, 0.0), fisheye=fisheye)
    _, pinhole = undistort(blob(60.0, 45.0), given)
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    distortion = np.array([k1, 0.0, 0.0, 0.0])
    pixels = project(rays(pinhole)[:, None], np.zeros(3), np.zeros(3), lens().matrix(), distortion)[0][:, 0]
    room = np.minimum(pixels, np.array([WIDTH - 1, HEIGHT - 1]) - pixels).min()
    assert room >= -1e-3
    if k1 > (1 / 3 if fisheye else 0):  # the photo covers the result, and no more than that
        assert 100.0 < pinhole.fx < 150.0
        assert room < 1e-3
    else:
        assert pinhole.fx == 100.0
    assert pinhole.fy / pinhole.fx == pytest.approx(0.98)


def test_no_distortion_changes_nothing() -> None:
    image = blob(30.0, 30.0)
    result, pinhole = undistort(image, lens(0.0, 0.0, 0.0, 0.0))
    assert result is image
    assert pinhole == lens()


def test_sizes_that_can_be_scaled_versions() -> None:
    full = Intrinsics(4032, 3024, 3000.0, 3000.0, 2016.0, 1512.0)
    assert all(full.same_aspect(*size) for size in ((504, 378), (501, 376), (1008, 756), (4032, 3024), (253, 190)))
    assert not any(full.same_aspect(*size) for size in ((3024, 4032), (504, 370), (500, 378)))
    assert Intrinsics(200, 149, 40.0, 40.0, 100.0, 74.5).same_aspect(216, 162)  # a twelfth of 2400x1799 and 2592x1944


@pytest.mark.parametrize("way", ["reduced", "remapped"])
def test_colours_without_weight_do_not_show(way: str) -> None:
    """One colour is seen, in some pixels in part, and hidden ones are noise: the means are that colour."""
    rng = np.random.default_rng(0)
    weights = blob(60.0, 45.0, 15.0)
    weights[weights < 0.3] = 0
    image = rng.random((HEIGHT, WIDTH, 3), np.float32)
    image[weights > 0] = [0.2, 0.5, 0.8]
    _, maps = rectification(lens(-0.2, 0.0, 0.0, 0.0))
    if way == "reduced":
        shown, left = (resize(part, lens(), 37, 29, weights)[0] for part in (image, weights))
    else:
        shown, left = (remap(part, maps, weights) for part in (image, weights))
    seen = left > 0
    assert 0 < seen.mean() < 1
    np.testing.assert_allclose(shown[seen], np.broadcast_to([0.2, 0.5, 0.8], (int(seen.sum()), 3)), atol=1e-5)
