"""Images as phones, cameras and editors write them: sizes, data behind them, tags, damage, the memory they take."""

from __future__ import annotations

import contextlib
import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
from new_files import write_anew
from PIL.ExifTags import Base
from refusals import refused
from tiny_scenes import plain_png, png_chunk, png_of, read_image

from kgs._support.errors import DataError
from kgs.datasets.image_file import ImageFile


def photo(height: int = 60, width: int = 80) -> np.ndarray:
    """A picture with detail in all three channels."""
    noise = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2))


def jpeg(*options: int, height: int = 60, width: int = 80) -> bytes:
    return bytes(cv2.imencode(".jpg", photo(height, width), options)[1].tobytes())


def stored(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


JPEGS: dict[str, tuple[int, ...]] = {
    "baseline": (),
    "progressive": (cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restarts": (cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
    "444": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
}
OTHERS = ("png", "webp", "bmp", "tif")


def encoded(kind: str) -> bytes:
    """A JPEG of this kind, or an image of another format."""
    if kind in JPEGS:
        return jpeg(*JPEGS[kind])
    return bytes(cv2.imencode(f".{kind}", photo())[1].tobytes())


@pytest.mark.parametrize("kind", [*JPEGS, *OTHERS])
def test_data_behind_an_image_change_nothing(tmp_path: Path, kind: str) -> None:
    """Phones put a video or a second picture behind a photo; any bytes may be in it, markers among them."""
    data = encoded(kind)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / np.float32(255)
    noise = np.random.default_rng(1).integers(0, 256, 20_000, np.uint8).tobytes()
    markers = b"\xff\xda" + noise, b"\xff\xd8\xff\xda"
    for behind in (b"", b"\0" * 9, *markers, noise, data, data[:-400], b"ftypmp42" * 99):
        np.testing.assert_array_equal(read_image(stored(tmp_path / "a", data + behind)), expected)


@pytest.mark.parametrize("kind", [*JPEGS, *OTHERS[:2]])
@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9, 0.99])
def test_images_cut_short_are_refused(tmp_path: Path, kind: str, kept: float) -> None:
    data = encoded(kind)
    with refused(DataError, path=tmp_path / "a"):
        read_image(stored(tmp_path / "a", data[: int(kept * len(data))]))


@pytest.mark.parametrize("kind", JPEGS)
def test_jpegs_that_libjpeg_warns_of_are_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str], kind: str) -> None:
    """Coded bytes are overwritten. OpenCV decodes the result and prints the decoder's warnings."""
    data, rng = encoded(kind), np.random.default_rng(3)
    begin, warned = data.index(b"\xff\xda") + 14, 0
    for at in rng.integers(begin, len(data) - 40, 40):
        damaged = data[:at] + rng.integers(0, 256, 6, np.uint8).tobytes() + data[at + 6 :]
        capfd.readouterr()
        cv2.imdecode(np.frombuffer(damaged, np.uint8), cv2.IMREAD_UNCHANGED)
        if capfd.readouterr().err:
            warned += 1
            with pytest.raises(DataError, match=r"a\.jpg: .* got one that is damaged"):
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


def tiff(pixels: np.ndarray, order: str = "<", **tags: int) -> bytes:
    """An uncompressed TIFF written from the format's description, with these tags; one plane for each channel if asked.

    A fourth or second channel is alpha unless `ExtraSamples` says something else.
    """
    height, width, channels = pixels.shape
    shorts = {
        256: width,
        257: height,
        258: 0,
        259: 1,
        262: 2 if channels > 2 else 1,
        277: channels,
        278: height,
        284: 1,
    }
    shorts |= {338: 2} if channels in (2, 4) else {}
    shorts |= {Base[name].value: value for name, value in tags.items()}
    planes = [pixels] if shorts[284] == 1 else np.split(pixels, channels, axis=2)
    strips = [plane.astype(pixels.dtype.newbyteorder(order)).tobytes() for plane in planes]
    bits = struct.pack(f"{order}{channels}H", *[8 * pixels.itemsize] * channels)
    counts = [len(strip) for strip in strips]
    behind = 8 + 2 + 12 * (len(shorts) + 2) + 4 + len(bits)  # where the lists of strips are, if there are several
    starts = [behind + 8 * len(strips) + sum(counts[:i]) for i in range(len(strips))]
    rows = {tag: (3, 1, struct.pack(order + "HH", value, 0)) for tag, value in shorts.items()}
    at = behind - len(bits)
    rows[258] = (3, channels, bits.ljust(4, b"\0") if channels < 3 else struct.pack(order + "I", at))
    for tag, numbers, at in ((273, starts, behind), (279, counts, behind + 4 * len(strips))):
        rows[tag] = (4, len(strips), struct.pack(order + "I", numbers[0] if len(strips) == 1 else at))
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "IH", 8, len(rows))
    head += b"".join(struct.pack(order + "HHI", tag, kind, n) + value for tag, (kind, n, value) in sorted(rows.items()))
    lists = struct.pack(f"{order}{2 * len(strips)}I", *starts, *counts)
    return head + bytes(4) + bits + lists + b"".join(strips)


TIFFS = pytest.mark.parametrize("kind", [np.uint8, np.uint16])


def pixels(kind: type[np.uint8] | type[np.uint16], channels: int) -> np.ndarray:
    return np.random.default_rng(2).integers(0, np.iinfo(kind).max, (5, 7, channels)).astype(kind)


@TIFFS
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize(("order", "orientation"), [("<", k) for k in range(1, 9)] + [(">", 1), (">", 6)])
def test_tiffs_come_as_they_are_stored_whatever_their_orientation(
    tmp_path: Path, kind: type[np.uint8], channels: int, order: str, orientation: int
) -> None:
    given = pixels(kind, channels)
    path = stored(tmp_path / "a.tif", tiff(given, order, Orientation=orientation))
    expected = np.broadcast_to(given, (5, 7, max(3, channels))) / np.float32(np.iinfo(kind).max)
    np.testing.assert_array_equal(read_image(path), expected)
    assert ImageFile(path).size == (7, 5)


def png_grey(bits: int, *chunks: bytes) -> bytes:
    """Two rows of a third of white, and the rest of it."""
    maximum = 2**bits - 1
    values = [maximum // 3, maximum - maximum // 3] if bits > 1 else [1, 0]
    row = int("".join(f"{value:0{bits}b}" for value in values).ljust(8, "0"), 2)
    data = png_of(zlib.compress((b"\0" + row.to_bytes(max(1, bits // 4), "big")) * 2), 2, 2)
    return data[:8] + png_chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 2, bits, 0, 0, 0, 0)) + b"".join(chunks) + data[33:]


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_greys_of_every_depth(tmp_path: Path, bits: int) -> None:
    image = read_image(stored(tmp_path / "a.png", png_grey(bits)))
    np.testing.assert_allclose(image[0, :, 0], [1, 0] if bits == 1 else [1 / 3, 2 / 3], atol=1e-6)


def test_alpha_of_grey_images(tmp_path: Path) -> None:
    grey = pixels(np.uint8, 2)
    image = read_image(stored(tmp_path / "a.tif", tiff(grey)))
    np.testing.assert_array_equal(image, grey[..., [0, 0, 0, 1]] / np.float32(255))
    rows = b"".join(b"\0" + bytes([200, 51]) * 3 for _ in range(2))
    image = read_image(stored(tmp_path / "a.png", png_of(zlib.compress(rows), 3, 2, color_type=4)))
    np.testing.assert_allclose(image, np.full((2, 3, 4), [200 / 255] * 3 + [0.2]), rtol=1e-6)
    clear = png_grey(8, png_chunk(b"tRNS", struct.pack(">H", 85)))
    np.testing.assert_array_equal(read_image(stored(tmp_path / "a.png", clear))[..., 3], [[0, 1]] * 2)


def by_pillow(mode: str, kind: str, **options: object) -> bytes:
    file = io.BytesIO()
    PIL.Image.new(mode, (7, 5)).save(file, kind, **options)
    return file.getvalue()


def png_saying(*chunks: tuple[bytes, bytes]) -> bytes:
    return png_grey(8, *(png_chunk(*chunk) for chunk in chunks))


def gamma(value: float) -> tuple[bytes, bytes]:
    return b"gAMA", struct.pack(">I", round(value * 100_000))


def primaries(*numbers: int) -> tuple[bytes, bytes]:
    """With sRGB's white."""
    return b"cHRM", struct.pack(">8I", 31270, 32900, *numbers)


DEEP = pixels(np.uint16, 3)
REFUSED = {
    "CMYK of a TIFF": by_pillow("CMYK", "TIFF"),
    "CMYK of a JPEG": by_pillow("CMYK", "JPEG"),
    "Lab": by_pillow("LAB", "TIFF"),
    "floating point": by_pillow("F", "TIFF"),
    "integers of 32 bits": by_pillow("I", "TIFF"),
    "separate planes": tiff(pixels(np.uint8, 3), PlanarConfiguration=2),
    "separate planes of 16 bits": tiff(DEEP, PlanarConfiguration=2),
    "a fourth channel of any meaning": tiff(pixels(np.uint8, 4), ExtraSamples=0),
    "a fourth channel of any meaning, 16 bits": tiff(pixels(np.uint16, 4), ExtraSamples=0),
    "colours multiplied by alpha": tiff(pixels(np.uint8, 4), ExtraSamples=1),
    "colours multiplied by alpha, 16 bits": tiff(pixels(np.uint16, 4), ExtraSamples=1),
    "grey multiplied by alpha": tiff(pixels(np.uint8, 2), ExtraSamples=1),
    "white is 0, 16 bits": tiff(DEEP[..., :1], PhotometricInterpretation=0),
    "a transparent grey of 2 bits": png_grey(2, png_chunk(b"tRNS", b"\0\1")),
    "a transparent grey of 16 bits": png_grey(16, png_chunk(b"tRNS", b"\0\1")),
    "PQ": png_saying((b"cICP", bytes([9, 16, 0, 1]))),
    "HLG": png_saying((b"cICP", bytes([9, 18, 0, 1]))),
    "P3": png_saying((b"cICP", bytes([12, 13, 0, 1]))),
    "linear light": png_saying((b"cICP", bytes([1, 8, 0, 1]))),
    "narrow range": png_saying((b"cICP", bytes([1, 13, 0, 0]))),
    "cICP before sRGB": png_saying((b"cICP", bytes([12, 13, 0, 1])), (b"sRGB", b"\0")),
    "a gamma of 1": png_saying(gamma(1.0)),
    "a gamma of 1.8": png_saying(gamma(1 / 1.8)),
    "primaries of P3": png_saying(gamma(0.45455), primaries(68000, 32000, 26500, 69000, 15000, 6000)),
    "primaries of Adobe RGB": png_saying(primaries(64000, 33000, 21000, 71000, 15000, 6000)),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_not_supported_is_refused_from_its_header(tmp_path: Path, kind: str) -> None:
    image = ImageFile(stored(tmp_path / "a", REFUSED[kind]))
    with pytest.raises(DataError, match="convert it to 8-bit RGB") as error:
        _ = image.size
    assert error.value.path == image.path


@pytest.mark.parametrize("compression", ["zstd", "lzma"])
def test_a_compression_that_opencv_lacks_is_refused_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], compression: str
) -> None:
    file = io.BytesIO()
    PIL.Image.fromarray(DEEP[..., 0]).save(file, "TIFF", compression=compression)
    with pytest.raises(DataError, match="expected an image"):
        read_image(stored(tmp_path / "a.tif", file.getvalue()))
    assert capfd.readouterr() == ("", "")


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
    assert ImageFile(path).size == size[::-1]
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
        write_anew(path, data[:length])
        with contextlib.suppress(DataError):
            assert ImageFile(path).size == (5, 4)
    path.write_bytes(data[:3])
    with pytest.raises(DataError, match="expected an image|expected a PNG"):
        _ = ImageFile(path).size


def test_other_formats_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"GIF89a" + bytes(20))
    with pytest.raises(DataError, match="expected a PNG, JPEG, WebP, BMP or TIFF"):
        _ = ImageFile(tmp_path / "a.png").size
