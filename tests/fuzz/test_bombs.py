"""Small files that ask for much memory, and the memory that images take."""

from __future__ import annotations

import gzip
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from cost import peak, read_within_bounds, reset_peak
from tiny_scenes import plain_png, read_image

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


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is measured on Linux")
@pytest.mark.parametrize(
    ("suffix", "shape", "kind"),
    [
        ("png", (1448, 1448), np.uint8),  # the largest that any file may be
        ("jpg", (1448, 1448, 3), np.uint8),
        ("jpg", (3000, 4000, 3), np.uint8),  # a photo of 12 megapixels
        ("png", (1448, 1448, 4), np.uint16),
    ],
)
def test_reading_an_image_takes_the_memory_that_is_estimated(
    tmp_path: Path, suffix: str, shape: tuple[int, ...], kind: type
) -> None:
    """At most 24 bytes per pixel, the file, and a few MiB for the decoder; docs/stiff-cases.md says so."""
    for size in (shape, (8, 8, *shape[2:])):  # the small one, which is read first, loads what reading needs
        path = tmp_path / f"{size[0]}.{suffix}"
        cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, size).astype(kind))
    read_image(path)
    path = tmp_path / f"{shape[0]}.{suffix}"
    before = reset_peak()
    image = read_image(path)
    assert image.size >= 3 * shape[0] * shape[1]
    assert peak() - before <= 24 * shape[0] * shape[1] + path.stat().st_size + 8 * 2**20
