"""The LLFF loader, on arrays made here from the format's description."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from kgs.datasets import load_scene
from kgs.errors import DataError

WIDTH, HEIGHT, COUNT, FOCAL = 48, 32, 10, 80.0  # of the file; the images are half that size
POINT = np.array([0.2, -0.1, 5.0])


def rows(seed: int = 0) -> np.ndarray:
    """`(10, 17)` rows: axes down, right, backward as columns, the centre, (height, width, focal); two depths."""
    rng = np.random.default_rng(seed)
    result = np.empty((COUNT, 17))
    for row in result:
        right, down, forward = cv2.Rodrigues(rng.normal(0, 0.05, 3))[0].T
        hwf = [HEIGHT, WIDTH, FOCAL]
        row[:15] = np.stack([down, right, -forward, rng.normal(0, 0.3, 3), hwf], axis=1).ravel()
        row[15:] = 1.0, 9.0
    return result


def write(root: Path, array: np.ndarray, folder: str = "images_2") -> None:
    root.mkdir(exist_ok=True)
    np.save(root / "poses_bounds.npy", array)
    (root / folder).mkdir()
    for i in range(COUNT):
        image = np.full((HEIGHT // 2, WIDTH // 2, 3), i, np.uint8)
        cv2.imwrite(str(root / folder / f"image{i:03d}.png"), image)


def test_images_is_preferred_then_the_largest_reduced_ones(tmp_path: Path) -> None:
    write(tmp_path, rows(), "images_4")
    (tmp_path / "images_8").mkdir()
    assert len(load_scene(tmp_path).train) == 8
    (tmp_path / "images").mkdir()
    with pytest.raises(DataError, match="10 poses, but images/ has 0 images"):
        load_scene(tmp_path)


def test_offset_is_the_mean_of_the_training_centres_and_nothing_else(tmp_path: Path) -> None:
    array = rows()
    write(tmp_path / "a", array)
    before = load_scene(tmp_path / "a", 3)
    np.testing.assert_allclose(before.offset, array[[1, 5, 9]][:, [3, 8, 13]].mean(axis=0), rtol=1e-14)
    rotation, translation = before.train.cameras.extrinsics.split((3, 1), dim=2)
    centers = -(rotation[:, :3].mT @ translation[:, :3])
    np.testing.assert_allclose(centers.mean(dim=0), np.zeros((3, 1)), atol=1e-6)
    others = [i for i in range(COUNT) if i not in (1, 5, 9)]
    array[others] = rows(seed=1)[others]
    write(tmp_path / "b", array)
    after = load_scene(tmp_path / "b", 3)
    assert torch.equal(before.offset, after.offset)
    assert torch.equal(before.train.cameras.extrinsics, after.train.cameras.extrinsics)
    assert not torch.equal(before.test.cameras.extrinsics, after.test.cameras.extrinsics)


def test_far_from_the_origin_no_digit_is_lost(tmp_path: Path) -> None:
    array = rows()
    write(tmp_path / "a", array)
    array[:, [3, 8, 13]] += [4e6, -5e5, 3e3]
    write(tmp_path / "b", array)
    near, far = load_scene(tmp_path / "a"), load_scene(tmp_path / "b")
    torch.testing.assert_close(near.train.cameras.extrinsics, far.train.cameras.extrinsics, atol=1e-6, rtol=0)


def with_value(row: int, column: int, value: float) -> np.ndarray:
    array = rows()
    array[row, column] = value
    return array


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (rows()[:, :16], r"\(N, 17\).*\(10, 16\)"),
        (rows()[:9], "9 poses, but images_2/ has 10 images"),
        (rows()[0], r"\(17,\)"),
        (rows().astype(np.int64), "int64"),
        (with_value(3, 2, np.nan), "row 3.*finite"),
        (with_value(3, 4, 32.5), "row 3.*whole pixels"),
        (with_value(3, 4, 0), "row 3.*whole pixels"),
        (with_value(3, 14, -80), r"image003\.png.*focal length"),
        (with_value(3, 0, 0.7), r"image003\.png.*rotation"),
        (with_value(3, 9, 60), r"image003\.png.*not a scaled version"),
    ],
)
def test_wrong_arrays(tmp_path: Path, array: np.ndarray, message: str) -> None:
    write(tmp_path, array)
    with pytest.raises(DataError, match=message):
        load_scene(tmp_path)


@pytest.mark.parametrize("bounds", [(0.0, 0.0), (9.0, 1.0), (np.nan, np.inf)])
def test_depths_are_not_used_whatever_they_are(tmp_path: Path, bounds: tuple[float, float]) -> None:
    array = rows()
    write(tmp_path, array)
    before = load_scene(tmp_path)
    array[:, 15:] = bounds
    np.save(tmp_path / "poses_bounds.npy", array)
    assert torch.equal(load_scene(tmp_path).train.cameras.extrinsics, before.train.cameras.extrinsics)


def header(shape: str, kind: str = "<f8") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"not numpy",
        b"PK\x03\x04 no zip",
        header("(3000000000000, 17)") + bytes(136),
        header("(18446744073709551616, 17)") + bytes(136),
        header("(-5, 17)") + bytes(136),
        header("(2, 17)") + bytes(136),
        header("(1, 17)", "|O") + bytes(136),
        header("(1, 17") + bytes(136),
    ],
)
def test_damaged_files_are_refused_before_memory_is_taken(tmp_path: Path, data: bytes) -> None:
    write(tmp_path, rows())
    (tmp_path / "poses_bounds.npy").write_bytes(data)
    with pytest.raises(DataError, match="poses_bounds"):
        load_scene(tmp_path)


def test_model_points_need_the_same_poses(tmp_path: Path) -> None:
    """A model written by hand with the poses of the rows gives its point; with one pose turned it is refused."""
    array = rows()
    write(tmp_path, array)
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 24 16 40 40 12 8\n")
    (folder / "points3D.txt").write_text("5 0.2 -0.1 5 255 0 0 1 2 0 3 0 4 0\n")
    # Rodrigues vectors to quaternions (w, x, y, z), world-to-camera: the turn is the transposed one
    lines = []
    for i, row in enumerate(array):
        matrix = row[:15].reshape(3, 5)
        turn = np.stack([matrix[:, 1], matrix[:, 0], -matrix[:, 2]])
        angle = cv2.Rodrigues(turn)[0].ravel()
        half = np.linalg.norm(angle) / 2
        quat = [np.cos(half), *(np.sin(half) * angle / (2 * half))]
        numbers = " ".join(repr(float(x)) for x in (*quat, *(-turn @ matrix[:, 3])))
        lines.append(f"{i + 1} {numbers} 1 IMG_{i}.JPG\n\n")
    (folder / "images.txt").write_text("".join(lines))
    scene = load_scene(tmp_path, points="model-points")
    assert scene.init_kind == "model-points"
    np.testing.assert_allclose((scene.points.double() + scene.offset).numpy(), [POINT], atol=1e-6)
    lines[4] = lines[4].replace("5 ", "5 -", 1)
    (folder / "images.txt").write_text("".join(lines))
    with pytest.raises(DataError, match="poses are not those"):
        load_scene(tmp_path, points="model-points")
    assert load_scene(tmp_path).init_kind == "none"
