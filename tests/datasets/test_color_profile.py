"""Photos whose files say that their colours are others than sRGB, in any way, come out in sRGB."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
from photo_folders import open_photos
from PIL import ImageCms
from tiny_scenes import png_chunk, read_image, write_colmap

from kgs._support.progress import silent
from kgs.app.sfm.read import read_photos
from kgs.datasets import load_scene
from kgs.datasets.image_file import ImageFile, color_notes

# The primaries of Display P3 adapted to D50 (SMPTE EG 432-1, Bradford), and their linear light in that of sRGB.
P3_COLORANTS = ((0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189), (0.15710, 0.06657, 0.78407))
P3_TO_SRGB = np.array([[1.2249402, -0.2249402, 0.0], [-0.0420569, 1.0420569, 0.0], [-0.0196376, -0.0786361, 1.0982736]])
SRGB_CURVE = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)

# Linear light in that of sRGB, from the numbers of Adobe RGB (1998).
ADOBE_TO_SRGB = np.array([[1.3983557, -0.3983557, 0.0], [0.0, 1.0, 0.0], [0.0, -0.0429290, 1.0429290]])


def fixed(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))


def icc(space: bytes, more: dict[bytes, bytes]) -> bytes:
    """A profile with these tags, written from the description of the format (ICC.1:2022)."""
    text = b"mluc" + struct.pack(">III2s2sII", 0, 1, 12, b"en", b"US", 4, 28) + "P3".encode("utf-16-be")
    tags = {b"desc": text, b"cprt": text, b"wtpt": b"XYZ " + bytes(4) + fixed(0.9642, 1.0, 0.8249)} | more
    table, body = struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        table += name + struct.pack(">II", 128 + 4 + 12 * len(tags) + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    head = struct.pack(">I4sI4s4s4s", 132 + len(table) - 4 + len(body), b"lcms", 0x04000000, b"mntr", space, b"XYZ ")
    head += struct.pack(">6H4s", 2026, 1, 1, 0, 0, 0, b"acsp") + bytes(28) + fixed(0.9642, 1.0, 0.8249)
    return head.ljust(128, b"\0") + table + body


def p3_profile() -> bytes:
    curve = b"para" + struct.pack(">IHH", 0, 3, 0) + fixed(*SRGB_CURVE)
    tags = {}
    for name, colorant in zip((b"r", b"g", b"b"), P3_COLORANTS, strict=True):
        tags[name + b"XYZ"] = b"XYZ " + bytes(4) + fixed(*colorant)
        tags[name + b"TRC"] = curve
    return icc(b"RGB ", tags)


def grey_profile(gamma: float) -> bytes:
    return icc(b"GRAY", {b"kTRC": b"para" + struct.pack(">IHH", 0, 0, 0) + fixed(gamma)})


def to_srgb(levels: np.ndarray, matrix: np.ndarray | None, gamma: float | None = None) -> np.ndarray:
    """The closed form: light by a curve (sRGB's without `gamma`), turned by a matrix, in sRGB's curve."""
    values = levels / 255
    light = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    light = light if gamma is None else values**gamma
    moved = np.clip(light if matrix is None else light @ matrix.T, 0, 1)
    return 255 * np.where(moved <= 0.0031308, moved * 12.92, 1.055 * moved ** (1 / 2.4) - 0.055)


def srgb_of_p3(levels: np.ndarray) -> np.ndarray:
    """Both spaces have one curve and one white, and differ by a matrix."""
    return to_srgb(levels, P3_TO_SRGB)


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


def exif(space: int | None, index: str = "", more: dict[int, object] | None = None) -> PIL.Image.Exif:
    """Exif that says of the colours: the number of their space, the index of interoperability, other tags."""
    block = PIL.Image.Exif()
    inner: dict[int, object] = {} if space is None else {0xA001: space}
    block[0x8769] = inner | ({0xA005: {1: index}} if index else {})
    for tag, value in (more or {}).items():
        block[tag] = value
    return block


def write(path: Path, levels: np.ndarray, block: PIL.Image.Exif) -> Path:
    options = {"quality": 100, "subsampling": 0} if path.suffix == ".jpg" else {"lossless": True}
    if path.suffix == ".tif":  # Pillow cannot write these directories into one
        data = PIL.Image.fromarray(levels)
        data.save(path)
        body = path.read_bytes()
        inner = struct.unpack_from("<I", body, 4)[0]
        count = struct.unpack_from("<H", body, inner)[0]
        entries = body[inner + 2 : inner + 2 + 12 * count]
        start = len(body) + len(body) % 2
        size = 2 + 12 * (count + 1) + 4
        new = struct.pack("<H", count + 1) + entries + struct.pack("<HHII", 0x8769, 4, 1, start + size) + bytes(4)
        new += struct.pack("<H", 2) + struct.pack("<HHII", 0xA001, 3, 1, 65535)
        new += struct.pack("<HHII", 0xA005, 4, 1, start + size + 30) + bytes(4)
        new += struct.pack("<H", 1) + struct.pack("<HHI4s", 1, 2, 4, b"R03\0") + bytes(4)
        path.write_bytes(body[:4] + struct.pack("<I", start) + body[8:].ljust(start - 8, b"\0") + new)
        return path
    PIL.Image.fromarray(levels).save(path, exif=block, **options)
    return path


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
def test_adobe_rgb_that_exif_alone_says_becomes_srgb(tmp_path: Path, suffix: str) -> None:
    """As cameras write it: the space is "uncalibrated", and the index of interoperability says which one that is."""
    path = write(tmp_path / f"a.{suffix}", patches(), exif(65535, "R03"))
    stored = cv2.imread(str(path))[..., ::-1]
    expected = to_srgb(stored, ADOBE_TO_SRGB, 563 / 256)
    assert np.abs(expected - stored).max() > 50
    np.testing.assert_allclose(read_image(path) * 255, expected, atol=0.1)
    (photo,) = read_photos(open_photos([path]), silent)
    np.testing.assert_allclose(photo.pixels, expected, atol=0.7)


def test_the_index_may_be_bytes(tmp_path: Path) -> None:
    """Of the type "undefined" instead of text, as some programs write it."""
    block = exif(65535, "R03").tobytes()
    order = "<" if b"II*\0" in block else ">"
    text, undefined = (struct.pack(f"{order}HHI", 1, kind, 4) for kind in (2, 7))
    assert block.count(text) == 1
    path = tmp_path / "a.png"
    PIL.Image.fromarray(patches()).save(path, exif=block.replace(text, undefined))
    np.testing.assert_allclose(read_image(path) * 255, to_srgb(patches(), ADOBE_TO_SRGB, 563 / 256), atol=0.1)


@pytest.mark.parametrize(
    ("block", "is_adobe", "doubted"),
    [
        pytest.param(exif(1, "R98"), False, False, id="sRGB"),
        pytest.param(exif(1, "R03"), False, False, id="sRGB that has both"),
        pytest.param(exif(2), True, False, id="2"),
        pytest.param(exif(None, "R03"), True, False, id="index alone"),
        pytest.param(exif(65535), False, True, id="uncalibrated"),
        pytest.param(exif(None), False, False, id="nothing"),
    ],
)
def test_what_exif_says_of_colours(tmp_path: Path, block: PIL.Image.Exif, is_adobe: bool, doubted: bool) -> None:
    path = write(tmp_path / "a.png", patches(), block)
    expected = to_srgb(patches(), ADOBE_TO_SRGB, 563 / 256) if is_adobe else patches()
    np.testing.assert_allclose(read_image(path) * 255, expected, atol=0.1)
    notes = color_notes([ImageFile(path)])
    assert len(notes) == doubted
    assert all("a.png" in note and "sRGB" in note for note in notes)


def test_of_many_photos_with_doubtful_colours_three_are_named(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"{i}.png", patches(), exif(65535)) for i in range(9)]
    (note,) = color_notes([ImageFile(path) for path in paths])
    assert note.endswith(": 0.png, 1.png, 2.png and 6 more")


def with_chunks(levels: np.ndarray, *chunks: tuple[bytes, bytes]) -> bytes:
    """Exif comes behind the pixels, other chunks before them."""
    data = cv2.imencode(".png", levels[..., ::-1])[1].tobytes()
    before, behind = (
        b"".join(png_chunk(*chunk) for chunk in chunks if (chunk[0] == b"eXIf") == is_behind)
        for is_behind in (False, True)
    )
    return data[:33] + before + data[33:-12] + behind + data[-12:]


def gamma_chunk(value: float) -> tuple[bytes, bytes]:
    return b"gAMA", struct.pack(">I", round(value * 100_000))


SRGB_CHROMATICITIES = (b"cHRM", struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000))
P3_CHUNK = (b"iCCP", b"P3\0\0" + zlib.compress(p3_profile()))
EXIF_CHUNK = (b"eXIf", exif(65535, "R03").tobytes().removeprefix(b"Exif\0\0"))
CHUNKS = {
    "gamma of sRGB": ([gamma_chunk(0.45455)], None, None),
    "gamma and primaries of sRGB": ([gamma_chunk(0.45455), SRGB_CHROMATICITIES], None, None),
    "sRGB before gamma": ([(b"sRGB", b"\0"), gamma_chunk(1.0)], None, None),
    "profile before gamma": ([P3_CHUNK, gamma_chunk(1.0)], P3_TO_SRGB, None),
    "cICP of sRGB before a profile": ([(b"cICP", bytes([1, 13, 0, 1])), P3_CHUNK], None, None),
    "cICP that says nothing": ([(b"cICP", bytes([2, 2, 0, 1])), EXIF_CHUNK], ADOBE_TO_SRGB, 563 / 256),
    "Exif behind the pixels": ([EXIF_CHUNK], ADOBE_TO_SRGB, 563 / 256),
    "damaged gamma": ([gamma_chunk(0)], None, None),
}


@pytest.mark.parametrize("kind", CHUNKS)
def test_what_a_png_says_of_colours(tmp_path: Path, kind: str) -> None:
    chunks, matrix, gamma = CHUNKS[kind]
    expected = patches() if matrix is None and gamma is None else to_srgb(patches(), matrix, gamma)
    (tmp_path / "a.png").write_bytes(with_chunks(patches(), *chunks))
    np.testing.assert_allclose(read_image(tmp_path / "a.png") * 255, expected, atol=1.5 if "profile" in kind else 0.1)


def test_both_readers_say_what_they_doubt(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    photo = next((tmp_path / "images").iterdir())
    PIL.Image.open(photo).save(photo, exif=exif(65535))
    notes = [note for note in load_scene(tmp_path, hold_out=0).notes if "sRGB" in note]
    assert len(notes) == 1
    assert photo.name in notes[0]


@pytest.mark.parametrize("kind", ["none", "sRGB", "damaged", "grey"])
def test_other_profiles_leave_every_bit_alone(tmp_path: Path, kind: str) -> None:
    profile = {
        "none": b"",
        "sRGB": ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
        "damaged": p3_profile()[:200],
        "grey": grey_profile(1.8),
    }[kind]
    levels = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (40, 50, 3), np.uint8), (0, 0), 1)
    np.testing.assert_array_equal(read_image(save(tmp_path / "a.png", profile, levels)), levels / np.float32(255))
