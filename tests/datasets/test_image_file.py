"""Sizes read from headers, against OpenCV's decoder, and images that are larger than their bytes can be."""

from __future__ import annotations

import contextlib
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from kgs.datasets.image_file import read_image, read_size
from kgs.errors import DataError


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "bmp", "tif"])
@pytest.mark.parametrize("size", [(1, 1), (7, 300), (129, 16)])
def test_headers_tell_what_is_decoded(tmp_path: Path, suffix: str, size: tuple[int, int]) -> None:
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (*size, 3), np.uint8))
    assert read_size(path) == size[::-1]
    assert read_image(path).shape[:2] == size


@pytest.mark.parametrize("quality", [80, 101])  # above 100: without loss
@pytest.mark.parametrize("channels", [3, 4])
def test_the_three_kinds_of_webp(tmp_path: Path, quality: int, channels: int) -> None:
    image = np.random.default_rng(0).integers(0, 255, (11, 23, channels), np.uint8)
    cv2.imwrite(str(tmp_path / "a.webp"), image, [cv2.IMWRITE_WEBP_QUALITY, quality])
    assert read_size(tmp_path / "a.webp") == (23, 11)


def png(width: int, height: int) -> bytes:
    """A PNG of one colour whose data are as small as they can be."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(width + 1)) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def test_the_plainest_real_image_is_read(tmp_path: Path) -> None:
    path = tmp_path / "plain.png"
    path.write_bytes(png(2000, 1000))  # a thousand pixels a byte
    assert read_image(path).shape == (1000, 2000, 3)


@pytest.mark.parametrize(("width", "height"), [(60_000, 60_000), (2**31 - 1, 1), (20_000, 2_000)])
def test_bombs_are_refused_before_they_are_decoded(tmp_path: Path, width: int, height: int) -> None:
    path, whole = tmp_path / "bomb.png", png(8, 8)
    head = whole[12:16] + struct.pack(">II", width, height) + whole[24:29]
    path.write_bytes(whole[:12] + head + struct.pack(">I", zlib.crc32(head)) + whole[33:])
    with pytest.raises(DataError, match=rf"bomb\.png.*claims {width}x{height} pixels"):
        read_image(path)


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "bmp", "tif"])
def test_cut_headers_are_data_errors(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), np.zeros((4, 5, 3), np.uint8))
    data = path.read_bytes()
    for length in range(min(len(data), 40)):
        path.write_bytes(data[:length])
        with contextlib.suppress(DataError):
            assert read_size(path) == (5, 4)
    path.write_bytes(data[:3])
    with pytest.raises(DataError, match="decoded"):
        read_size(path)


def test_other_formats_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"GIF89a" + bytes(20))
    with pytest.raises(DataError, match="expected a PNG, JPEG, WebP, BMP or TIFF"):
        read_size(tmp_path / "a.png")
