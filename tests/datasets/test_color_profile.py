"""Photos with a colour profile, as phones and editors write them, come out in sRGB."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
from PIL import ImageCms
from tiny_scenes import png_chunk

from kgs.app.sfm.read import open_photos, read_photos
from kgs.datasets.image_file import read_image
from kgs.progress import silent

# The primaries of Display P3 adapted to D50 (SMPTE EG 432-1, Bradford), and their linear light in that of sRGB.
P3_COLORANTS = ((0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189), (0.15710, 0.06657, 0.78407))
P3_TO_SRGB = np.array([[1.2249402, -0.2249402, 0.0], [-0.0420569, 1.0420569, 0.0], [-0.0196376, -0.0786361, 1.0982736]])
SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)


def fixed(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))


def p3_profile() -> bytes:
    """A profile of Display P3, written from the description of the format (ICC.1:2022)."""
    curve = b"para" + struct.pack(">IHH", 0, 3, 0) + fixed(*SRGB_CURVE)
    text = b"mluc" + struct.pack(">III2s2sII", 0, 1, 12, b"en", b"US", 4, 28) + "P3".encode("utf-16-be")
    tags = {b"desc": text, b"cprt": text, b"wtpt": b"XYZ " + bytes(4) + fixed(0.9642, 1.0, 0.8249)}
    for name, colorant in zip((b"r", b"g", b"b"), P3_COLORANTS, strict=True):
        tags[name + b"XYZ"] = b"XYZ " + bytes(4) + fixed(*colorant)
        tags[name + b"TRC"] = curve
    table, body = struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        table += name + struct.pack(">II", 128 + 4 + 12 * len(tags) + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    head = struct.pack(">I4sI4s4s4s", 132 + len(table) - 4 + len(body), b"lcms", 0x04000000, b"mntr", b"RGB ", b"XYZ ")
    head += struct.pack(">6H4s", 2026, 1, 1, 0, 0, 0, b"acsp") + bytes(28) + fixed(0.9642, 1.0, 0.8249)
    return head.ljust(128, b"\0") + table + body


def srgb_of_p3(levels: np.ndarray) -> np.ndarray:
    """The closed form: both spaces have one curve and one white, and differ by a matrix."""
    values = levels / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    moved = np.clip(linear @ P3_TO_SRGB.T, 0, 1)
    return 255 * np.where(moved <= 0.0031308, moved * 12.92, 1.055 * moved ** (1 / 2.4) - 0.055)


def patches() -> np.ndarray:
    """A plain square of 16 pixels for each of 64 colours."""
    colors = np.stack(np.meshgrid(*[[0, 80, 160, 255]] * 3, indexing="ij"), axis=-1).reshape(8, 8, 3)
    return np.ascontiguousarray(colors.repeat(16, axis=0).repeat(16, axis=1).astype(np.uint8))


def save(path: Path, profile: bytes, levels: np.ndarray) -> Path:
    options = {"quality": 100, "subsampling": 0} if path.suffix == ".jpg" else {"lossless": True}
    PIL.Image.fromarray(levels).save(path, icc_profile=profile, **options)
    return path


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif"])
def test_display_p3_becomes_srgb(tmp_path: Path, suffix: str) -> None:
    path = save(tmp_path / f"a.{suffix}", p3_profile(), patches())
    stored = cv2.imread(str(path))[..., ::-1]  # OpenCV passes profiles over
    expected = srgb_of_p3(stored)
    assert np.abs(expected - stored).max() > 50
    np.testing.assert_allclose(read_image(path) * 255, expected, atol=1.5)


def test_alpha_stays_and_16_bits_are_converted_too(tmp_path: Path) -> None:
    alpha = np.arange(128 * 128, dtype=np.uint32).reshape(128, 128, 1).astype(np.uint8)
    image = read_image(save(tmp_path / "a.png", p3_profile(), np.concatenate([patches(), alpha], axis=2)))
    np.testing.assert_array_equal(image[..., 3:], alpha / np.float32(255))
    np.testing.assert_allclose(image[..., :3] * 255, srgb_of_p3(patches()), atol=1.5)
    data = cv2.imencode(".png", patches()[..., ::-1].astype(np.uint16) * 257)[1].tobytes()
    chunk = png_chunk(b"iCCP", b"P3\0\0" + zlib.compress(p3_profile()))
    (tmp_path / "deep.png").write_bytes(data[:33] + chunk + data[33:])  # behind the header
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png"), image[..., :3])


def test_unposed_photos_are_converted(tmp_path: Path) -> None:
    paths = [save(tmp_path / f"{i}.png", p3_profile(), np.roll(patches(), 16 * i, axis=0)) for i in range(3)]
    for i, photo in enumerate(read_photos(open_photos(paths), silent)):
        np.testing.assert_allclose(photo.pixels, srgb_of_p3(np.roll(patches(), 16 * i, axis=0)), atol=1.5)


@pytest.mark.parametrize("kind", ["none", "sRGB", "damaged", "grey"])
def test_other_profiles_leave_every_bit_alone(tmp_path: Path, kind: str) -> None:
    profile = {
        "none": b"",
        "sRGB": ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
        "damaged": p3_profile()[:200],
        "grey": p3_profile().replace(b"RGB ", b"GRAY", 1),
    }[kind]
    levels = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (40, 50, 3), np.uint8), (0, 0), 1)
    np.testing.assert_array_equal(read_image(save(tmp_path / "a.png", profile, levels)), levels / np.float32(255))
