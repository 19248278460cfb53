"""Small files that ask for much memory, and what other programs write beside and behind what kgs reads."""

from __future__ import annotations

import gzip
import json
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from cost import read_within_bounds
from damage import GEOMETRIC_KEYS
from tiny_scenes import plain_png, read_image, update_json, write_blender, write_image, write_nerfstudio

from kgs._support.errors import DataError
from kgs.datasets import Views, load_scene
from kgs.init_points.files import read_points

SIDE = 8000


def grey_png(path: Path) -> None:
    path.write_bytes(plain_png(SIDE, SIDE))


def grey_jpeg(path: Path) -> None:
    assert cv2.imwrite(str(path), np.full((SIDE, SIDE), 128, np.uint8))


def zipped_points(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.xyz", b"1 2 3\n" * 30_000_000)


def gzipped_points(path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 30000000\n" + "".join(f"property float {x}\n" for x in "xyz")
    path.write_bytes(gzip.compress(f"{header}end_header\n".encode() + b"0 0 0\n" * 30_000_000, 6))


@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is measured on Linux")
@pytest.mark.parametrize(
    ("name", "write", "read", "largest"),
    [
        ("image.png", grey_png, read_image, 100_000),
        ("image.jpg", grey_jpeg, read_image, 1_100_000),
        ("points.zip", zipped_points, read_points, 600_000),
        *[
            pytest.param(f"points.{ending}", gzipped_points, read_points, 600_000, marks=pytest.mark.slow)
            for ending in ("ply.gz", "gz", "tar.gz", "ply")
        ],
    ],
)
def test_small_files_that_ask_for_much_memory_are_refused(
    tmp_path: Path, name: str, write: Callable[[Path], None], read: Callable[[Path], object], largest: int
) -> None:
    write(path := tmp_path / name)
    assert path.stat().st_size < largest
    assert read_within_bounds(read, path) == "refused"


KEYS = [
    (write, key, in_a_frame)
    for write in (write_blender, write_nerfstudio)
    for key in GEOMETRIC_KEYS
    for in_a_frame in (False, True)
]


@pytest.mark.parametrize(("write", "key", "in_a_frame"), KEYS)
def test_a_key_is_used_refused_or_noted(
    tmp_path: Path, write: Callable[[Path], None], key: str, in_a_frame: bool
) -> None:
    """What a file says about cameras and pictures is never passed over in silence."""
    write(tmp_path)
    if key.startswith("camera_angle"):
        for path in tmp_path.glob("transforms.json"):  # a focal length says the same, and comes first
            content = json.loads(path.read_text())
            kept = {name: value for name, value in content.items() if name not in ("fl_x", "fl_y")}
            path.write_text(json.dumps({**kept, "camera_angle_x": 0.9}))
    plain = load_scene(tmp_path)
    for path in tmp_path.glob("transforms*.json"):
        update_json(path, 0 if in_a_frame else None, **{key: GEOMETRIC_KEYS[key]})
    try:
        scene = load_scene(tmp_path)
    except DataError:
        return
    noted = any(key in note for note in scene.notes)
    assert noted or any(numbers(a) != numbers(b) for a, b in ((scene.train, plain.train), (scene.test, plain.test)))


def numbers(views: Views) -> list[list[float]]:
    """All that a fit takes from views."""
    return [x.flatten().tolist() for x in (views.images, views.cameras.intrinsics, views.cameras.extrinsics)]


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif", "bmp"])
@pytest.mark.parametrize("behind", [b"\0", b"\xff\xd8\xff\xe1 film \xff\xd9", bytes(range(256)) * 40], ids=len)
def test_data_behind_an_image_change_nothing(tmp_path: Path, suffix: str, behind: bytes) -> None:
    write_image(tmp_path, suffix)
    path = tmp_path / f"image.{suffix}"
    plain = read_image(path)
    path.write_bytes(path.read_bytes() + behind)
    assert np.array_equal(read_image(path), plain)
