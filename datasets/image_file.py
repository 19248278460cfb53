"""An image on disk, read by Pillow: opened once, decoded once, its colours converted to sRGB.

Two kinds of pixels are decoded by others. Those of a JPEG by libjpeg-turbo (kornia_rs): both give the same bits, but
Pillow is silent about damaged ones, whose colours are wrong. And 16-bit integers by OpenCV, because Pillow cuts them to
8 bits.
"""

import io
import warnings
from pathlib import Path
from typing import IO, Any, NamedTuple

import cv2
import numpy as np
from kornia_rs import io as kornia_io
from numpy.typing import NDArray
from PIL import BmpImagePlugin, JpegImagePlugin, PngImagePlugin, TiffImagePlugin, WebPImagePlugin
from PIL.Image import Exif
from PIL.ImageFile import ImageFile as Opened

from kgs.errors import DataError

from . import folders
from .color_profile import to_srgb

Image = NDArray[np.float32]
_PLUGINS: dict[str, type[Opened]] = {
    "PNG": PngImagePlugin.PngImageFile,
    "JPEG": JpegImagePlugin.JpegImageFile,
    "WebP": WebPImagePlugin.WebPImageFile,
    "BMP": BmpImagePlugin.BmpImageFile,
    "TIFF": TiffImagePlugin.TiffImageFile,
}
_KINDS = {
    b"\x89PNG\r\n\x1a\n": "PNG",
    b"\xff\xd8": "JPEG",
    b"RIFF": "WebP",
    b"BM": "BMP",
    b"II*\0": "TIFF",
    b"MM\0*": "TIFF",
}
_HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
_LONGEST_SIGNATURE = 12  # bytes
_PNG_BITS = 24  # the byte of a PNG that has the bits of a sample
_TO_RGB = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
# Tags of TIFF and Exif
_BITS = 258
_COLORS = 262
_ORIENTATION = 274
_SAMPLES = 277
_TILE_WIDTH = 322
_TILE_HEIGHT = 323
_EXTRA_SAMPLES = 338
_EXIF = 34665
_LAB = {8: "CIELab", 9: "ICCLab", 10: "ITULab"}  # values of `_COLORS` that are decoded wrongly
_MULTIPLIED_ALPHA = 1  # a value of `_EXTRA_SAMPLES`
_ALPHA = 2  # likewise


class Metadata(NamedTuple):
    """What an image file says besides its pixels."""

    size: tuple[int, int]  # width and height of the stored pixels
    tags: dict[int, Any]  # of the image and its Exif directory, as Pillow gives them; empty if damaged
    profile: bytes = b""  # ICC; empty if there is none


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
        """Size, tags and colour profile, from the header."""
        if self._metadata is None:
            if self._data is None:
                self._metadata = _read_header_of_file(self.path)
            else:
                self._metadata = _read_header(self.path, io.BytesIO(self._data), len(self._data))
        return self._metadata

    def read(self) -> Image:
        """The pixels as stored: RGB `(H, W, 3)`, or RGBA `(H, W, 4)` where the file has an alpha channel.

        Values are sRGB in [0, 1], not multiplied by alpha. The file's bytes are not kept.
        """
        data = self.load()
        kind = _kind(self.path, data[:_LONGEST_SIGNATURE])
        metadata = self.metadata  # the size is checked before anything is decoded
        try:
            pixels = _decode(kind, data)
        except ValueError as error:
            raise DataError(self.path, "", str(error)) from error
        height, width = pixels.shape[:2]
        if metadata.size != (width, height):
            raise DataError(self.path, "", f"expected {metadata.size} pixels as its header says, got {(width, height)}")
        self._data = None
        return to_srgb(pixels, metadata.profile)


def read_image(path: Path) -> Image:
    """The pixels of an image: see `ImageFile.read`."""
    return ImageFile(path).read()


def read_size(path: Path) -> tuple[int, int]:
    """Width and height of an image: see `ImageFile.size`."""
    return ImageFile(path).size


def read_bytes(path: Path) -> bytes:
    """The bytes of a whole file; a DataError if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(path, "", f"cannot be read ({error.strerror})") from error


def is_heic(data: bytes) -> bool:
    """Whether a file that begins with these bytes is a HEIC image."""
    return data[4:8] == b"ftyp" and data[8:12] in _HEIC_BRANDS


def _kind(path: Path, head: bytes) -> str:
    """The format of a file that begins with these bytes; a DataError about `path` where it cannot be read."""
    if is_heic(head) and folders.has_heic():
        return "HEIC"
    for signature, kind in _KINDS.items():
        if head.startswith(signature):
            return kind
    raise DataError(path, "", "cannot be decoded: expected a PNG, JPEG, WebP, BMP or TIFF image")


def _read_header_of_file(path: Path) -> Metadata:
    try:
        with path.open("rb") as file:
            length = file.seek(0, io.SEEK_END)
            file.seek(0)
            return _read_header(path, file, length)
    except OSError as error:
        raise DataError(path, "", f"cannot be read ({error.strerror})") from error


def _read_header(path: Path, file: IO[bytes], length: int) -> Metadata:
    """Size, tags and colour profile of an image file of `length` bytes."""
    kind = _kind(path, file.read(_LONGEST_SIGNATURE))
    file.seek(0)
    try:
        with warnings.catch_warnings(action="ignore"):  # Pillow warns of damaged metadata
            image = _open(kind, file)
            tags = _tags(image)
        if kind == "HEIC":
            tags[_ORIENTATION] = _left_to_turn(image, file)
        size = (image.width, image.height)
        tile = (1, 1)
        if kind == "TIFF":
            if int(tags.get(_ORIENTATION, 1)) in (5, 6, 7, 8):
                size = size[::-1]  # Pillow gives that of the upright image
            tiff = image.tag_v2  # type: ignore[attr-defined]  # of TIFF only
            tile = int(tiff.get(_TILE_WIDTH, 1)), int(tiff.get(_TILE_HEIGHT, 1))
    except Exception as error:  # damaged bytes raise whatever Pillow's plugins happen to raise
        raise DataError(path, "", f"cannot be decoded: damaged, cut short, or an unusual {kind} ({error})") from error
    check_size(path, *size, length)
    check_size(path, *tile, length)  # tiles are decoded whole
    return Metadata(size, tags, image.info.get("icc_profile") or b"")


def _open(kind: str, file: IO[bytes]) -> Opened:
    """An image whose header Pillow has read.

    Not by `PIL.Image.open`, because its bound on pixels does not depend on the number of bytes in the file.
    """
    if kind == "HEIC":
        import pi_heif

        opened: Opened = pi_heif.HeifImageFile(file)
        return opened
    return _PLUGINS[kind](file)


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
        return dict(exif) | exif.get_ifd(_EXIF)
    except Exception:  # Pillow has no error of its own for damage
        return {}


def _left_to_turn(image: Opened, file: IO[bytes]) -> int:
    """By which orientation of Exif the decoded pixels of a HEIC image are still to be turned.

    Its decoder applies turning and mirroring (irot, imir) of the file, and Exif only repeats them. Some programs
    write Exif alone.
    """
    file.seek(0)
    data = file.read()
    if b"irot" in data or b"imir" in data:
        return 1
    return image.info.get("original_orientation") or 1


def check_size(path: Path, width: int, height: int, size: int) -> None:
    """Raise DataError about `path` if so many pixels should not be decoded from a file of `size` bytes."""
    if width < 1 or height < 1:
        raise DataError(path, "header", f"expected an image of at least 1x1 pixels, got {width}x{height}")
    # Photos have fewer than 20 pixels per byte, a PNG of one colour 1032. Any file may have 2^21 pixels (48 MiB while
    # decoded); images of one colour may have 2^24 (384 MiB). More, up to 2^28, need a byte for every 32.
    if width * height > min(2**28, max(2**21, min(2**24, 2048 * size), 32 * size)):
        raise DataError(path, "header", f"claims {width}x{height} pixels in {size} bytes: a decompression bomb")


def _decode(kind: str, data: bytes) -> Image:
    """RGB or RGBA in [0, 1] of an image's bytes, whose size was checked; a ValueError where it cannot be decoded."""
    try:
        if kind == "JPEG":
            return _to_float(_decode_jpeg(data))
        if kind == "TIFF":
            return _decode_tiff(data)
        if kind == "PNG":
            _open(kind, io.BytesIO(data)).verify()  # the check sums, which decoders pass over
            if data[_PNG_BITS] == 16:
                return _to_float(_decode_with_opencv(data))
        return _to_float(_decode_with_pillow(_open(kind, io.BytesIO(data))))
    except (ValueError, MemoryError):
        raise
    except Exception as error:  # neither Pillow, kornia_rs nor OpenCV has one class of errors for damage
        raise ValueError("the image is damaged, truncated, or has other colours than grey or RGB") from error


def _to_float(pixels: NDArray[np.uint8 | np.uint16]) -> Image:
    """Values in [0, 1] from 8 or 16 bit integers."""
    return np.asarray(pixels / np.float32(255.0 if pixels.dtype == np.uint8 else 65535.0), dtype=np.float32)


def _decode_with_pillow(image: Opened) -> NDArray[np.uint8]:
    """RGB or RGBA of an image of 8 bits or less, upright if it is a TIFF or HEIC."""
    with warnings.catch_warnings(action="ignore"):  # Pillow warns of many pixels: the size was checked
        return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))


def _decode_with_opencv(data: bytes) -> NDArray[np.uint8 | np.uint16]:
    """RGB or RGBA, upright if it is a TIFF."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("OpenCV cannot decode this as an image (truncated, or no image?)")
    channels = image.shape[2] if image.ndim == 3 else 1
    if image.dtype not in (np.uint8, np.uint16) or channels not in _TO_RGB:
        raise ValueError(f"expected 8 or 16 bit integers in 1, 3 or 4 channels, got {image.dtype} in {channels}")
    return np.asarray(cv2.cvtColor(image, _TO_RGB[channels]))


def _decode_jpeg(data: bytes) -> NDArray[np.uint8]:
    """RGB of a JPEG. What lies behind its end, such as a phone's video, is ignored."""
    file = io.BytesIO(data)
    image = _open("JPEG", file)
    end = file.tell()  # of the header of the first scan
    # Only progressive images use its last three bytes. In others some phones leave them 0, and decoders warn of it.
    if "progressive" not in image.info and data[end - 3 : end] == b"\0\0\0":
        data = data[: end - 3] + b"\0\x3f\0" + data[end:]
    return np.asarray(kornia_io.decode_image_jpegturbo(data, "rgb"))


def _decode_tiff(data: bytes) -> Image:
    """RGB or RGBA in [0, 1] of a TIFF, as stored, its colours not multiplied by alpha."""
    image = _open("TIFF", io.BytesIO(data))
    tags = image.tag_v2  # type: ignore[attr-defined]  # of TIFF only
    if lab := _LAB.get(int(tags.get(_COLORS, 2))):
        raise ValueError(f"expected a TIFF of grey or RGB, got {lab}")
    orientation = int(tags.get(_ORIENTATION, 1))
    samples = int(tags.get(_SAMPLES, 1))
    alpha = tags.get(_EXTRA_SAMPLES, (0,))[0]
    # Pillow leaves out a fourth sample of unspecified meaning and rounds when it divides colours by alpha.
    if max(tags.get(_BITS, (1,))) <= 8 and (samples != 4 or alpha == _ALPHA):
        pixels = _to_float(_decode_with_pillow(image))
    else:
        pixels = _to_float(_decode_with_opencv(data))
    if samples == 4 and alpha == _MULTIPLIED_ALPHA:
        pixels[..., :3] = np.minimum(pixels[..., :3] / np.maximum(pixels[..., 3:], 1 / 65535), 1)
    # Both decoders turned the image upright: turn it back. 6 and 8 undo each other, all others undo themselves.
    return np.ascontiguousarray(turn(pixels, {6: 8, 8: 6}.get(orientation, orientation)))


def turn(image: NDArray[Any], orientation: int) -> NDArray[Any]:
    """An image `(H, W, K)` upright, as Exif's orientation from 1 to 8 says; a view where that is possible."""
    if orientation in (2, 4, 5, 7):  # mirrored: 2 alone, the others turned as 3, 6 and 8 are
        image = image[:, ::-1]
    return np.rot90(image, {3: 2, 4: 2, 5: 1, 6: 3, 7: 3, 8: 1}.get(orientation, 0))
