"""Images as phones, cameras and editors write them: sizes, data behind them, tags, damage, the memory they take."""

from __future__ import annotations

import contextlib
import json
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_scenes import plain_png, png_chunk, png_of

from kgs._support.errors import DataError
from kgs.datasets.image_file import read_image, read_size


def photo(height: int = 60, width: int = 80) -> np.ndarray:
    """A picture with detail in all three channels."""
    noise = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2))


def jpeg(*options: int, height: int = 60, width: int = 80) -> bytes:
    return bytes(cv2.imencode(".jpg", photo(height, width), options)[1].tobytes())


def stored(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


KINDS = pytest.mark.parametrize(
    "options",
    [
        (),
        (cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        (cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
        (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
    ],
    ids=["baseline", "progressive", "restarts", "444"],
)


@KINDS
def test_jpegs_with_data_behind_them(tmp_path: Path, options: tuple[int, ...]) -> None:
    """Phones put a video or a second picture behind a photo; any bytes may be in it, markers among them."""
    data = jpeg(*options)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / np.float32(255)
    noise = np.random.default_rng(1).integers(0, 256, 20_000, np.uint8).tobytes()
    markers = b"\xff\xda" + noise, b"\xff\xd8\xff\xda"
    for behind in (b"", b"\0" * 9, *markers, noise, data, data[:-400], b"ftypmp42" * 99):
        np.testing.assert_array_equal(read_image(stored(tmp_path / "a.jpg", data + behind)), expected)


@KINDS
@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9, 0.99])
def test_jpegs_cut_short_are_refused_whatever_comes_behind(
    tmp_path: Path, options: tuple[int, ...], kept: float
) -> None:
    data = jpeg(*options)
    with pytest.raises(DataError, match=r"a\.jpg.*damaged"):
        read_image(stored(tmp_path / "a.jpg", data[: int(kept * len(data))]))


@KINDS
def test_jpegs_that_libjpeg_warns_of_are_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], options: tuple[int, ...]
) -> None:
    """Coded bytes are overwritten. OpenCV decodes the result and prints the decoder's warnings."""
    data, rng = jpeg(*options), np.random.default_rng(3)
    begin, warned = data.index(b"\xff\xda") + 14, 0
    for at in rng.integers(begin, len(data) - 40, 40):
        damaged = data[:at] + rng.integers(0, 256, 6, np.uint8).tobytes() + data[at + 6 :]
        capfd.readouterr()
        cv2.imdecode(np.frombuffer(damaged, np.uint8), cv2.IMREAD_UNCHANGED)
        if capfd.readouterr().err:
            warned += 1
            with pytest.raises(DataError, match=r"a\.jpg: pixels: .* damaged, cut short"):
                read_image(stored(tmp_path / "a.jpg", damaged))
    assert warned >= 8


def test_scan_parameters_that_mean_nothing_are_no_damage(tmp_path: Path) -> None:
    """Some phones leave the three bytes 0 that only progressive images need; decoders warn and go on."""
    data = jpeg()
    at = data.index(b"\xff\xda") + 2
    end = at + struct.unpack_from(">H", data, at)[0]
    assert data[end - 3 : end] == b"\0\x3f\0"
    odd = read_image(stored(tmp_path / "odd.jpg", data[: end - 3] + b"\0\0\0" + data[end:]))
    np.testing.assert_array_equal(odd, read_image(stored(tmp_path / "a.jpg", data)))


def tiff(pixels: np.ndarray, orientation: int = 1, alpha: int = 2, order: str = "<") -> bytes:
    """An uncompressed TIFF written from the format's description; alpha: 0 unspecified, 1 multiplied in, 2 not."""
    height, width, channels = pixels.shape
    body = pixels.astype(pixels.dtype.newbyteorder(order)).tobytes()
    shorts = {256: width, 257: height, 258: 0, 259: 1, 262: 2 if channels > 2 else 1, 274: orientation, 277: channels}
    shorts |= {278: height, 284: 1} | ({338: alpha} if channels in (2, 4) else {})
    tags = sorted({*shorts, 273, 279})
    behind = 8 + 2 + 12 * len(tags) + 4
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "IH", 8, len(tags))
    for tag in tags:
        if tag in (273, 279):
            head += struct.pack(order + "HHII", tag, 4, 1, behind + 2 * channels if tag == 273 else len(body))
        elif tag == 258 and channels > 2:
            head += struct.pack(order + "HHII", tag, 3, channels, behind)
        elif tag == 258:
            head += struct.pack(order + "HHIHH", tag, 3, channels, *[8 * pixels.itemsize] * 2)
        else:
            head += struct.pack(order + "HHIHH", tag, 3, 1, shorts[tag], 0)
    return head + bytes(4) + struct.pack(f"{order}{channels}H", *[8 * pixels.itemsize] * channels) + body


TIFFS = pytest.mark.parametrize("kind", [np.uint8, np.uint16])


def pixels(kind: type[np.uint8] | type[np.uint16], channels: int) -> np.ndarray:
    return np.random.default_rng(2).integers(0, np.iinfo(kind).max, (5, 7, channels)).astype(kind)


@TIFFS
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_tiffs_come_as_they_are_stored_whatever_their_orientation(
    tmp_path: Path, kind: type[np.uint8], order: str, orientation: int
) -> None:
    given = pixels(kind, 3)
    path = stored(tmp_path / "a.tif", tiff(given, orientation, order=order))
    np.testing.assert_array_equal(read_image(path), given / np.float32(np.iinfo(kind).max))
    assert read_size(path) == (7, 5)


@TIFFS
@pytest.mark.parametrize("orientation", [1, 3])
@pytest.mark.parametrize("alpha", [0, 2])
def test_transparent_tiffs_keep_their_colours(
    tmp_path: Path, kind: type[np.uint8], orientation: int, alpha: int
) -> None:
    given = pixels(kind, 4)
    image = read_image(stored(tmp_path / "a.tif", tiff(given, orientation, alpha)))
    np.testing.assert_array_equal(image, given / np.float32(np.iinfo(kind).max))


@TIFFS
def test_colours_that_a_tiff_multiplies_by_alpha_are_divided_by_it(tmp_path: Path, kind: type[np.uint8]) -> None:
    maximum = np.iinfo(kind).max
    colors, alpha = pixels(kind, 3), np.maximum(pixels(kind, 1), maximum // 2)
    alpha[0, 0] = 0
    stored_colors = np.round(colors / maximum * alpha).astype(kind)
    image = read_image(stored(tmp_path / "a.tif", tiff(np.concatenate([stored_colors, alpha], axis=2), alpha=1)))
    np.testing.assert_allclose(image[1:, ..., :3], colors[1:] / maximum, atol=1.1 / maximum)
    assert np.isfinite(image).all()
    assert not image[0, 0].any()


def test_tiffs_of_lab_are_refused_and_those_of_cmyk_read(tmp_path: Path) -> None:
    pillow, path = pytest.importorskip("PIL.Image"), tmp_path / "a.tif"
    pillow.new("LAB", (7, 5)).save(path)
    with pytest.raises(DataError, match="colours: expected grey or RGB, got CIELab"):
        read_image(path)
    pillow.new("RGB", (7, 5), (200, 60, 30)).convert("CMYK").save(path)
    np.testing.assert_array_equal(read_image(path)[..., :3] * 255, np.broadcast_to([200, 60, 30], (5, 7, 3)))


def test_a_tiff_in_which_white_is_zero(tmp_path: Path) -> None:
    for kind in (np.uint8, np.uint16):
        grey = pixels(kind, 1)
        data = tiff(grey).replace(struct.pack("<HHIHH", 262, 3, 1, 1, 0), struct.pack("<HHIHH", 262, 3, 1, 0, 0))
        image = read_image(stored(tmp_path / "a.tif", data))
        np.testing.assert_allclose(image, 1 - (grey / np.iinfo(kind).max).repeat(3, axis=2), atol=1e-6)


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_the_grey_that_a_png_makes_transparent(tmp_path: Path, bits: int) -> None:
    maximum = 2**bits - 1
    clear = maximum // 3 if bits > 1 else 1
    values = [clear, maximum - clear]
    row = int("".join(f"{value:0{bits}b}" for value in values).ljust(8, "0"), 2)
    rows = (b"\0" + row.to_bytes(max(1, bits // 4), "big")) * 2
    chunk = png_chunk(b"tRNS", struct.pack(">H", clear))
    data = png_of(zlib.compress(rows), 2, 2)
    head = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 2, bits, 0, 0, 0, 0))
    image = read_image(stored(tmp_path / "a.png", data[:8] + head + chunk + data[33:]))
    assert image.shape == (2, 2, 4)
    np.testing.assert_allclose(image[..., 0], np.broadcast_to(np.array(values) / maximum, (2, 2)), atol=1e-6)
    np.testing.assert_array_equal(image[..., 3], [[0, 1]] * 2)


def test_alpha_of_grey_images_is_used_or_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="TIFF that is damaged, cut short or unusual"):
        read_image(stored(tmp_path / "a.tif", tiff(pixels(np.uint16, 2))))
    multiplied = np.broadcast_to(np.array([40, 51], np.uint8), (5, 7, 2))
    image = read_image(stored(tmp_path / "a.tif", tiff(multiplied, alpha=1)))
    np.testing.assert_allclose(image * 255, np.broadcast_to([200, 200, 200, 51], (5, 7, 4)), atol=1e-3)
    grey = pixels(np.uint8, 2)
    image = read_image(stored(tmp_path / "a.tif", tiff(grey)))
    np.testing.assert_array_equal(image, grey[..., [0, 0, 0, 1]] / np.float32(255))
    rows = b"".join(b"\0" + bytes([200, 51]) * 3 for _ in range(2))
    image = read_image(stored(tmp_path / "a.png", png_of(zlib.compress(rows), 3, 2, color_type=4)))
    np.testing.assert_allclose(image, np.full((2, 3, 4), [200 / 255] * 3 + [0.2]), rtol=1e-6)


WITHOUT_LOSS = (cv2.IMWRITE_WEBP_QUALITY, 101)


@pytest.mark.parametrize("size", [(1, 1), (7, 300), (129, 16)])
@pytest.mark.parametrize(
    ("suffix", "channels", "options"),
    [(suffix, 3, ()) for suffix in ("png", "jpg", "webp", "bmp", "tif")]
    + [("webp", 4, ()), ("webp", 3, WITHOUT_LOSS), ("webp", 4, WITHOUT_LOSS)],
)
def test_headers_tell_what_is_decoded(
    tmp_path: Path, suffix: str, channels: int, options: tuple[int, ...], size: tuple[int, int]
) -> None:
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (*size, channels), np.uint8), options)
    assert read_size(path) == size[::-1]
    assert read_image(path).shape == (*size, channels)


def test_the_plainest_real_image_is_read(tmp_path: Path) -> None:
    path = tmp_path / "plain.png"
    path.write_bytes(plain_png(2000, 1000))  # a thousand pixels a byte
    assert read_image(path).shape == (1000, 2000, 3)


@pytest.mark.parametrize(("width", "height"), [(60_000, 60_000), (2**31 - 1, 1), (20_000, 2_000)])
def test_bombs_are_refused_before_they_are_decoded(tmp_path: Path, width: int, height: int) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png_of(zlib.compress(bytes(72)), width, height))
    with pytest.raises(DataError, match=rf"bomb\.png: header: .*, got {width}x{height}"):
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
    with pytest.raises(DataError, match="decoded|expected a PNG"):
        read_size(path)


def test_other_formats_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"GIF89a" + bytes(20))
    with pytest.raises(DataError, match="expected a PNG, JPEG, WebP, BMP or TIFF"):
        read_size(tmp_path / "a.png")


MEASURE = """
import json, os, sys
from pathlib import Path
from kgs.datasets.image_file import read_image
def status(name):
    return int(next(l for l in open("/proc/self/status") if l.startswith(name)).split()[1]) * 1024
for path in sys.argv[1:]:
    child = os.fork()  # each image in a process of its own
    if child == 0:
        read_image(Path(path).with_name("small" + Path(path).suffix))
        open("/proc/self/clear_refs", "w").write("5")
        before = status("VmRSS")
        image = read_image(Path(path))
        print(json.dumps([Path(path).name, status("VmHWM") - before, image.size]), flush=True)
        os._exit(0)
    os.waitpid(child, 0)
"""
IMAGES: dict[str, tuple[tuple[int, ...], type[np.uint8] | type[np.uint16]]] = {
    "plain.png": ((1448, 1448), np.uint8),  # the largest that any file may be
    "plain.jpg": ((1448, 1448, 3), np.uint8),
    "noise.jpg": ((3000, 4000, 3), np.uint8),  # a photo of 12 megapixels
    "deep.png": ((1448, 1448, 4), np.uint16),
}


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, int, int]]:
    """Of each image: the memory that reading it took, its numbers, and the bytes of its file."""
    folder = tmp_path_factory.mktemp("images")
    for suffix in ("png", "jpg"):
        cv2.imwrite(str(folder / f"small.{suffix}"), np.zeros((8, 8, 3), np.uint8))
    for name, (shape, kind) in IMAGES.items():
        image = np.full(shape, 77, kind)
        if name.startswith("noise"):
            image = np.random.default_rng(0).integers(0, 255, shape, np.uint8)
        cv2.imwrite(str(folder / name), image)
    command = [sys.executable, "-c", MEASURE, *(folder / name for name in IMAGES)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = map(json.loads, run.stdout.splitlines())
    return {name: (used, values, (folder / name).stat().st_size) for name, used, values in rows}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is measured on Linux")
@pytest.mark.parametrize("name", IMAGES)
def test_reading_an_image_takes_the_memory_that_is_estimated(
    name: str, measured: dict[str, tuple[int, int, int]]
) -> None:
    """At most 24 bytes per pixel, the file, and a few MiB for the decoder; docs/stiff-cases.md says so."""
    used, values, file_bytes = measured[name]
    shape, _ = IMAGES[name]
    pixel_count = shape[0] * shape[1]
    assert values >= 3 * pixel_count
    assert 12 * pixel_count <= used <= 24 * pixel_count + file_bytes + 8 * 2**20
