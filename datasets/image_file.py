"""A photo's file: opened once, decoded once, its colours converted to sRGB.

What Pillow decodes as grey, RGB or RGBA of 8 bits is supported, and PNG and TIFF of 16 bits, which Pillow cuts to 8,
through OpenCV. All else is refused in one line. Kornia decodes JPEGs: Pillow gives the same bits, but takes damaged
files, too.
"""

import contextlib
import io
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import cv2
import numpy as np
from kornia_rs import io as kornia_io
from numpy.typing import NDArray
from PIL import BmpImagePlugin, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin
from PIL.ExifTags import IFD, Base
from PIL.Image import Exif
from PIL.ImageFile import ImageFile as Opened

from kgs._support.errors import DataError, cause_of, listed
from kgs._support.extras import check_opencv

from . import folders
from .color_profile import ADOBE_RGB, SRGB, Profile, is_usable, to_srgb

check_opencv()
Image = NDArray[np.float32]
_PLUGINS: dict[bytes, type[Opened]] = {
    b"\x89PNG\r\n\x1a\n": PngImagePlugin.PngImageFile,
    b"\xff\xd8": JpegImagePlugin.JpegImageFile,
    b"RIFF": WebPImagePlugin.WebPImageFile,
    b"BM": BmpImagePlugin.BmpImageFile,
    b"II*\0": TiffImagePlugin.TiffImageFile,
    b"MM\0*": TiffImagePlugin.TiffImageFile,
}
_HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
# Modes of Pillow that are supported, of 8 bits and fewer, and of 16.
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")
_MODES_OF_16 = ("I;16", "I;16B", "LA", "RGB", "RGBA")
_TO_RGB = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
# Numbers of H.273 for primaries and curves that viewers show as sRGB's: those of BT.601 and 709, and unset ones.
_SRGB_PRIMARIES = (0, 1, 2, 5, 6, 7)
_SRGB_CURVES = (0, 1, 2, 4, 6, 13, 14, 15)
_RGB_OF_FULL_RANGE = (0, 1)
_UNSPECIFIED = (2, 2)
_SRGB_CHROMATICITIES = (0.3127, 0.3290, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06)  # x and y of white, red, green and blue
_SRGB_GAMMA = 1 / 2.2  # nearly, as libpng has it
_SEPARATE = 2  # of a TIFF's `Base.PlanarConfiguration`
_STRAIGHT_ALPHA = 2  # of its `Base.ExtraSamples`
_IS_SRGB, _IS_ADOBE_RGB, _UNCALIBRATED = 1, 2, 65535  # of `Base.ColorSpace`, the second of some cameras


class Metadata(NamedTuple):
    """What an image file says besides its pixels."""

    size: tuple[int, int]  # width and height of the stored pixels
    bits: int  # of a sample, 1 to 16
    tags: dict[int, Any]  # of the image and its Exif directory, as Pillow gives them; empty if damaged
    profile: Profile = ""  # of its colours; empty if nothing is said


class ImageFile:
    """A PNG, JPEG, WebP, BMP, TIFF or HEIC file. The file is opened on first use.

    Args:
        path: of the file.

    Raises:
        DataError: in every method, if the file cannot be read, is of another kind, damaged, cut short, or claims more
            pixels than its bytes can hold (a decompression bomb).
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._data: bytes | None = None
        self._metadata: Metadata | None = None

    def load(self) -> bytes:
        """The file's bytes. They are kept until `read`, so that the file is not opened again."""
        if self._data is None:
            self._data = read_bytes(self.path)
        return self._data

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels as stored: an orientation in the metadata is not applied."""
        return self.metadata.size

    @property
    def metadata(self) -> Metadata:
        """Size, bits, tags and colour profile, from the header."""
        if self._metadata is None:
            try:
                file: IO[bytes] = self.path.open("rb") if self._data is None else io.BytesIO(self._data)
                with file:
                    self._metadata = _read_header(self.path, file)
            except OSError as error:
                raise DataError(self.path, "", "a file that can be read", advice=f"{error.strerror}") from error
        return self._metadata

    def read(self) -> Image:
        """The pixels as stored: RGB `(H, W, 3)`, or RGBA `(H, W, 4)` where the file has an alpha channel.

        Values are sRGB in [0, 1], not multiplied by alpha. The file's bytes are not kept.
        """
        data = self.load()
        metadata = self.metadata  # the size is checked before anything is decoded
        file = io.BytesIO(data)
        plugin = _plugin(self.path, file)
        try:
            pixels = _decode(plugin(file), data, metadata)
        except MemoryError:
            raise
        except Exception as error:  # neither Pillow, Kornia nor OpenCV has one class of errors for damage
            advice = cause_of(error)
            raise DataError(self.path, "", "an image", "one that is damaged or cut short", advice=advice) from error
        height, width = pixels.shape[:2]
        if metadata.size != (width, height):
            raise DataError(self.path, "", f"{metadata.size} pixels as its header says", (width, height))
        self._data = None
        return to_srgb(np.asarray(pixels / np.float32(2 ** max(8, metadata.bits) - 1), np.float32), metadata.profile)


def color_notes(images: Sequence[ImageFile]) -> list[str]:
    """A sentence that names photos whose colours may be others than sRGB; or []."""
    names = []
    for image in images:
        header = image.metadata
        is_unnamed = not header.profile and header.tags.get(Base.ColorSpace) == _UNCALIBRATED
        if is_unnamed or not is_usable(header.profile):
            names.append(image.path.name)
    said = "taken for sRGB, though their colour profile is missing or cannot be used"
    return [f"{said}: {listed(names)}"] if names else []


def read_bytes(path: Path) -> bytes:
    """The bytes of a whole file; a DataError if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(path, "", "a file that can be read", advice=f"{error.strerror}") from error


def is_heic(data: bytes) -> bool:
    """Whether a file that begins with these bytes is a HEIC image."""
    return data[4:8] == b"ftyp" and data[8:12] in _HEIC_BRANDS


def turn(image: NDArray[Any], orientation: int) -> NDArray[Any]:
    """An image `(H, W, K)` upright, as Exif's orientation from 1 to 8 says; a view where that is possible."""
    if orientation in (2, 4, 5, 7):  # mirrored: 2 alone, the others turned as 3, 6 and 8 are
        image = image[:, ::-1]
    return np.rot90(image, {3: 2, 4: 2, 5: 1, 6: 3, 7: 3, 8: 1}.get(orientation, 0))


def _plugin(path: Path, file: IO[bytes]) -> type[Opened]:
    """What reads a file; a DataError about `path` where nothing does.

    `PIL.Image.open` is not used: its bound on pixels does not depend on the number of bytes in the file.
    """
    head = file.read(12)
    file.seek(0)
    if not head:
        raise DataError(path, "", "an image", "an empty file")
    plugin = next((plugin for signature, plugin in _PLUGINS.items() if head.startswith(signature)), None)
    if is_heic(head) and folders.has_heic():
        import pi_heif

        plugin = pi_heif.HeifImageFile
    if plugin is None:
        raise DataError(path, "", "a PNG, JPEG, WebP, BMP or TIFF image", "another file")
    return plugin


def _read_header(path: Path, file: IO[bytes]) -> Metadata:
    """What a file says besides its pixels; a DataError if these cannot be decoded."""
    plugin = _plugin(path, file)
    length = file.seek(0, io.SEEK_END)
    file.seek(0)
    try:
        with warnings.catch_warnings(action="ignore"):  # Pillow warns of damaged metadata
            image = plugin(file)
            chunks = _png_chunks(file) if image.format == "PNG" else {}
            image.info |= {"exif": chunks[b"eXIf"]} if b"eXIf" in chunks else {}
            tags = _tags(image)
        bits = chunks[b"IHDR"][8] if chunks else 8
        size = (image.width, image.height)
        tile = (1, 1)
        if image.format == "TIFF":
            tiff = image.tag_v2  # type: ignore[attr-defined]  # of TIFF only
            bits = max(tiff.get(Base.BitsPerSample, (1,)))
            tile = int(tiff.get(Base.TileWidth, 1)), int(tiff.get(Base.TileLength, 1))
            if int(tags.get(Base.Orientation, 1)) in (5, 6, 7, 8):
                size = size[::-1]  # Pillow gives that of the upright image
    except Exception as error:  # damaged bytes raise whatever Pillow's plugins happen to raise
        got = f"a {plugin.format} that is damaged, cut short or unusual"
        raise DataError(path, "", "an image", got, advice=cause_of(error)) from error
    _check_size(path, *size, length)
    _check_size(path, *tile, length)  # tiles are decoded whole
    try:
        _check_samples(image, bits)
        profile = _profile(image, chunks.get(b"cICP", b""), tags)
    except ValueError as error:
        raise DataError(path, "", "grey or RGB of 8 bits", str(error), advice="convert it to 8-bit RGB") from error
    return Metadata(size, bits, tags, profile)


def _png_chunks(file: IO[bytes]) -> dict[bytes, bytes]:
    """What Pillow does not tell of a PNG: its bits, cICP, and an eXIf that comes behind the pixels."""
    found = dict[bytes, bytes]()
    file.seek(8)
    while len(head := file.read(8)) == 8:
        length, kind = struct.unpack(">I4s", head)
        if kind in (b"IHDR", b"cICP", b"eXIf"):
            found[kind] = file.read(length)
            length = 0
        file.seek(length + 4, io.SEEK_CUR)  # the check sum
    return found


def _tags(image: Opened) -> dict[int, Any]:
    """The tags of an image and of its Exif directory; none if they are damaged."""
    try:
        if "exif" in image.info:
            exif = Exif()
            exif.load(image.info["exif"])
        elif image.format == "TIFF":
            exif = image.getexif()
        else:
            return {}
        tags = dict(exif) | exif.get_ifd(IFD.Exif)
        with contextlib.suppress(Exception):
            tags[IFD.Interop] = exif.get_ifd(IFD.Interop).get(1)
        return tags
    except Exception:  # Pillow has no error of its own for damage
        return {}


def _check_size(path: Path, width: int, height: int, size: int) -> None:
    """Raise DataError about `path` if so many pixels should not be decoded from a file of `size` bytes."""
    if width < 1 or height < 1:
        raise DataError(path, "header", "an image of at least 1x1 pixels", f"{width}x{height}")
    # Photos have fewer than 20 pixels per byte, a PNG of one colour 1032. Any file may have 2^21 pixels (48 MiB while
    # decoded); images of one colour may have 2^24 (384 MiB). More, up to 2^28, need a byte for every 32.
    max_pixels = min(2**28, max(2**21, min(2**24, 2048 * size), 32 * size))
    if width * height > max_pixels:
        expected = f"at most {max_pixels} pixels in {size} bytes"
        raise DataError(path, "header", expected, f"{width}x{height}", advice="it is a decompression bomb")


def _check_samples(image: Opened, bits: int) -> None:
    """Raise a ValueError that names what the samples of an image are, unless kgs reads them."""
    if image.mode not in (_MODES_OF_16 if bits > 8 else _MODES) or 8 < bits != 16:
        raise ValueError(f"{image.mode} of {bits} bits")
    if image.format == "PNG" and "transparency" in image.info and image.mode != "P" and bits != 8:
        raise ValueError(f"a transparent colour of {bits} bits")
    if image.format != "TIFF":
        return
    tags = image.tag_v2  # type: ignore[attr-defined]  # of TIFF only
    samples = int(tags.get(Base.SamplesPerPixel, 1))
    alpha = tags.get(Base.ExtraSamples, (_STRAIGHT_ALPHA,))[0]
    refused = {
        "channels in separate planes": samples > 1 and tags.get(Base.PlanarConfiguration) == _SEPARATE,
        "a last channel that is not straight alpha": samples in (2, 4) and alpha != _STRAIGHT_ALPHA,
        "16 bits in which white is 0": bits == 16 and tags.get(Base.PhotometricInterpretation) == 0,
    }
    for what, is_so in refused.items():
        if is_so:
            raise ValueError(what)


def _profile(image: Opened, cicp: bytes, tags: dict[int, Any]) -> Profile:
    """What a file says of its colours, what counts more first; a ValueError that names them if they are not read."""
    info = image.info
    icc = info.get("icc_profile")
    nclx = info.get("nclx_profile")
    numbers = tuple(cicp)
    if nclx and not icc:
        numbers = (nclx["color_primaries"], nclx["transfer_characteristics"], *_RGB_OF_FULL_RANGE)
    if numbers:
        primaries, curve, *rest = numbers
        if primaries not in _SRGB_PRIMARIES or curve not in _SRGB_CURVES or tuple(rest) != _RGB_OF_FULL_RANGE:
            raise ValueError(f"HDR or other colours than sRGB's (numbers {primaries} and {curve} of H.273)")
        if (primaries, curve) != _UNSPECIFIED:
            return SRGB
    elif icc:
        return bytes(icc)
    elif image.format == "PNG" and info.keys() & {"srgb", "gamma", "chromaticity"}:
        gamma = info.get("gamma") or _SRGB_GAMMA
        chromaticities = info.get("chromaticity", _SRGB_CHROMATICITIES)
        is_close = np.allclose(chromaticities, _SRGB_CHROMATICITIES, 0, 0.003) and abs(gamma / _SRGB_GAMMA - 1) <= 0.05
        if not is_close and "srgb" not in info:
            raise ValueError("a gamma or primaries that are not sRGB's")
        return SRGB
    space = tags.get(Base.ColorSpace)
    if space == _IS_SRGB:
        return SRGB
    is_adobe = space == _IS_ADOBE_RGB or "R03" in str(tags.get(IFD.Interop))  # of some programs it is bytes
    return ADOBE_RGB if is_adobe else ""


def _decode(image: Opened, data: bytes, header: Metadata) -> NDArray[np.uint8 | np.uint16]:
    """RGB or RGBA as stored of an image whose header was checked."""
    if image.format == "JPEG":
        return _decode_jpeg(image, data)
    if image.format == "PNG":
        type(image)(io.BytesIO(data)).verify()  # the check sums, which decoders pass over
    if header.bits == 16:
        pixels = _decode_with_opencv(data)
    else:
        with warnings.catch_warnings(action="ignore"):  # Pillow warns of many pixels: the size was checked
            pixels = np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))
    if image.format != "TIFF":
        return pixels
    # Both decoders turned the image upright: turn it back. 6 and 8 undo each other, all others undo themselves.
    orientation = int(header.tags.get(Base.Orientation, 1))
    return np.ascontiguousarray(turn(pixels, {6: 8, 8: 6}.get(orientation, orientation)))


def _decode_jpeg(image: Opened, data: bytes) -> NDArray[np.uint8]:
    """RGB of a JPEG that was opened. What lies behind the image is ignored."""
    assert image.fp is not None
    end = image.fp.tell()  # of the header of the first scan
    # Only progressive images use its last three bytes. In others some phones leave them 0, and decoders warn of it.
    if "progressive" not in image.info and data[end - 3 : end] == b"\0\0\0":
        data = data[: end - 3] + b"\0\x3f\0" + data[end:]
    return np.asarray(kornia_io.decode_image_jpegturbo(data, "rgb"))


def _decode_with_opencv(data: bytes) -> NDArray[np.uint16]:
    """RGB or RGBA of a PNG or TIFF of 16 bits, the latter upright."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the error says all in one line
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None or image.dtype != np.uint16:
        raise ValueError("or compressed in a way that OpenCV cannot read")
    return np.asarray(cv2.cvtColor(image, _TO_RGB[image.shape[2] if image.ndim == 3 else 1]))
