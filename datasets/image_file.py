"""An image on disk, read by Pillow: opened once, decoded once, its colours converted to sRGB.

OpenCV decodes integers of 16 bits, which Pillow cuts to 8, and Kornia JPEGs: Pillow gives the same bits, but takes
damaged ones, too, whose colours are wrong.
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

from kgs._support.errors import ArgumentError, DataError, cause_of, listed
from kgs._support.extras import check_opencv

from . import folders
from .color_profile import ADOBE_RGB, Colors, Profile, cmyk_to_rgb, colors_of, is_usable, to_srgb

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
_MAX_SIGNATURE = 12  # bytes
_PNG_BITS = 24  # the byte of a PNG that has the bits of a sample
_LISTED = 10
_TO_RGB = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
# Values of tags of TIFF and Exif
_LAB = {8: "CIELab", 9: "ICCLab", 10: "ITULab"}  # of `Base.PhotometricInterpretation`: decoded wrongly
_WHITE_IS_ZERO = 0  # of `Base.PhotometricInterpretation`
_CMYK = 5  # likewise
_MULTIPLIED_ALPHA = 1  # of `Base.ExtraSamples`
_ALPHA = 2  # likewise
_IS_SRGB = 1  # of `Base.ColorSpace`
_IS_ADOBE_RGB = 2  # likewise, of some cameras
_IS_OTHER = 65535  # likewise
_UNSPECIFIED = (2, 2)  # primaries and curve in nclx


class Metadata(NamedTuple):
    """What an image file says besides its pixels."""

    size: tuple[int, int]  # width and height of the stored pixels
    tags: dict[int, Any]  # of the image and its Exif directory, as Pillow gives them; empty if damaged
    profile: Profile = b""  # of its colours; empty if nothing is said


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
        try:
            pixels = _decode(_plugin(self.path, data[:_MAX_SIGNATURE]), data)
        except ArgumentError as error:
            raise error.about(self.path) from error
        height, width = pixels.shape[:2]
        if metadata.size != (width, height):
            raise DataError(self.path, "", f"{metadata.size} pixels as its header says", (width, height))
        self._data = None
        return to_srgb(pixels, metadata.profile)

    @property
    def doubt(self) -> str:
        """Why its colours may be others than sRGB, which they are taken for; "" where all is well."""
        if not is_usable(self.metadata.profile):
            return "the colour profile is damaged or of another kind"
        if not self.metadata.profile and self.metadata.tags.get(Base.ColorSpace) == _IS_OTHER:
            return "the Exif says that they are not, and not what they are"
        return ""


def color_notes(images: Sequence[ImageFile]) -> list[str]:
    """A sentence for each reason to doubt that colours of photos are sRGB."""
    doubted: dict[str, list[str]] = {}
    for image in images:
        if image.doubt:
            doubted.setdefault(image.doubt, []).append(image.path.name)
    return [f"colours are taken for sRGB, but {doubt}: {listed(names, _LISTED)}" for doubt, names in doubted.items()]


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
        raise DataError(path, "", "a file that can be read", advice=f"{error.strerror}") from error


def is_heic(data: bytes) -> bool:
    """Whether a file that begins with these bytes is a HEIC image."""
    return data[4:8] == b"ftyp" and data[8:12] in _HEIC_BRANDS


def _plugin(path: Path, head: bytes) -> type[Opened]:
    """What reads a file that begins with these bytes; a DataError about `path` where nothing does.

    `PIL.Image.open` is not used: its bound on pixels does not depend on the number of bytes in the file.
    """
    if not head:
        raise DataError(path, "", "an image", "an empty file")
    if is_heic(head) and folders.has_heic():
        import pi_heif

        plugin: type[Opened] = pi_heif.HeifImageFile
        return plugin
    for signature, plugin in _PLUGINS.items():
        if head.startswith(signature):
            return plugin
    raise DataError(path, "", "a PNG, JPEG, WebP, BMP or TIFF image", "another file")


def _read_header(path: Path, file: IO[bytes]) -> Metadata:
    """Size, tags and colour profile of an image file."""
    plugin = _plugin(path, file.read(_MAX_SIGNATURE))
    length = file.seek(0, io.SEEK_END)
    file.seek(0)
    try:
        with warnings.catch_warnings(action="ignore"):  # Pillow warns of damaged metadata
            image = plugin(file)
            chunks = _png_chunks(file) if image.format == "PNG" else {}
            image.info |= {"exif": chunks[b"eXIf"]} if b"eXIf" in chunks else {}
            tags = _tags(image)
        if image.format == "HEIF":
            tags[Base.Orientation] = _left_to_turn(image, file)
        size = (image.width, image.height)
        tile = (1, 1)
        if image.format == "TIFF":
            if int(tags.get(Base.Orientation, 1)) in (5, 6, 7, 8):
                size = size[::-1]  # Pillow gives that of the upright image
            tiff = image.tag_v2  # type: ignore[attr-defined]  # of TIFF only
            tile = int(tiff.get(Base.TileWidth, 1)), int(tiff.get(Base.TileLength, 1))
    except Exception as error:  # damaged bytes raise whatever Pillow's plugins happen to raise
        got = f"a {plugin.format} that is damaged, cut short or unusual"
        raise DataError(path, "", "an image that can be decoded", got, advice=cause_of(error)) from error
    check_size(path, *size, length)
    check_size(path, *tile, length)  # tiles are decoded whole
    try:
        profile = _profile(image, file, chunks, tags)
    except ArgumentError as error:
        raise error.about(path) from error
    return Metadata(size, tags, profile)


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


def _png_chunks(file: IO[bytes]) -> dict[bytes, bytes]:
    """What Pillow does not read of a PNG: cICP, and an eXIf that comes behind the pixels."""
    found = dict[bytes, bytes]()
    file.seek(8)
    while len(head := file.read(8)) == 8:
        length, kind = struct.unpack(">I4s", head)
        if kind in (b"cICP", b"eXIf"):
            found[kind] = file.read(length)
            length = 0
        file.seek(length + 4, io.SEEK_CUR)  # the check sum
    return found


def _profile(image: Opened, file: IO[bytes], chunks: dict[bytes, bytes], tags: dict[int, Any]) -> Profile:
    """What a file says of its colours, what counts more first; a ValueError where they cannot be converted."""
    icc: bytes = image.info.get("icc_profile") or (_bmp_profile(file) if image.format == "BMP" else b"")
    if image.format == "PNG" and len(cicp := chunks.get(b"cICP", b"")) == 4:
        primaries, curve, matrix, full = cicp
        if (matrix, full) != (0, 1):
            raise ArgumentError("cICP", "RGB of the full range", f"matrix {matrix} and range {full}")
        return colors_of(primaries, curve)
    if icc:
        return icc
    if image.format == "PNG" and "srgb" in image.info:
        return Colors()
    if image.format == "PNG" and ("gamma" in image.info or "chromaticity" in image.info):
        chromaticities = image.info.get("chromaticity") or (*Colors().white, *sum(Colors().primaries, ()))
        exponent = image.info.get("gamma")
        return Colors.of(chromaticities[:2], chromaticities[2:], 1 / exponent if exponent else None) or b""
    nclx = image.info.get("nclx_profile")
    if nclx and (nclx["color_primaries"], nclx["transfer_characteristics"]) != _UNSPECIFIED:
        return colors_of(nclx["color_primaries"], nclx["transfer_characteristics"])
    space = tags.get(Base.ColorSpace)
    if space == _IS_SRGB:
        return Colors()
    index = tags.get(IFD.Interop)
    index = index.decode("latin-1") if isinstance(index, bytes) else str(index)
    if space == _IS_ADOBE_RGB or index.startswith("R03"):
        return ADOBE_RGB
    if Base.WhitePoint in tags and Base.PrimaryChromaticities in tags:
        return Colors.of(tags[Base.WhitePoint], tags[Base.PrimaryChromaticities], tags.get(Base.Gamma)) or b""
    return b""


def _bmp_profile(file: IO[bytes]) -> bytes:
    """The ICC profile in a BMP of version 5, b"" if there is none."""
    file.seek(14)
    head = file.read(124)
    if len(head) < 124 or head[56:60] != b"DEBM" or head[:4] != struct.pack("<I", 124):
        return b""
    start, length = struct.unpack_from("<II", head, 112)
    file.seek(14 + start)
    return file.read(length)


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
        raise DataError(path, "header", "an image of at least 1x1 pixels", f"{width}x{height}")
    # Photos have fewer than 20 pixels per byte, a PNG of one colour 1032. Any file may have 2^21 pixels (48 MiB while
    # decoded); images of one colour may have 2^24 (384 MiB). More, up to 2^28, need a byte for every 32.
    most = min(2**28, max(2**21, min(2**24, 2048 * size), 32 * size))
    if width * height > most:
        expected = f"at most {most} pixels in {size} bytes"
        raise DataError(path, "header", expected, f"{width}x{height}", advice="it is a decompression bomb")


def _decode(plugin: type[Opened], data: bytes) -> Image:
    """RGB or RGBA in [0, 1] of an image's bytes, whose size was checked; a ValueError where it cannot be decoded."""
    try:
        file = io.BytesIO(data)
        image = plugin(file)
        if image.format == "TIFF":
            return _decode_tiff(image, data)
        if image.format == "JPEG":
            return _to_float(_decode_jpeg(image, data, file.tell()))
        if image.format == "PNG":
            plugin(io.BytesIO(data)).verify()  # the check sums, which decoders pass over
            return _to_float(_decode_png(image, data))
        return _to_float(_decode_with_pillow(image))
    except (ArgumentError, MemoryError):
        raise
    except Exception as error:  # neither Pillow, Kornia nor OpenCV has one class of errors for damage
        got = "ones that are damaged, cut short, or have other colours than grey or RGB"
        raise ArgumentError("pixels", "those of an image", got, advice=cause_of(error)) from error


def _to_float(pixels: NDArray[np.uint8 | np.uint16]) -> Image:
    """Values in [0, 1] from 8 or 16 bit integers."""
    return np.asarray(pixels / np.float32(255.0 if pixels.dtype == np.uint8 else 65535.0), dtype=np.float32)


def _decode_with_pillow(image: Opened) -> NDArray[np.uint8]:
    """RGB or RGBA of an image of 8 bits or less, upright if it is a TIFF or HEIC."""
    with warnings.catch_warnings(action="ignore"):  # Pillow warns of many pixels: the size was checked
        if image.mode == "La":  # which Pillow converts to nothing that has colours
            return np.asarray(image)[..., [0, 0, 0, 1]]
        return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))


def _decode_with_opencv(data: bytes) -> NDArray[np.uint8 | np.uint16]:
    """RGB or RGBA, upright if it is a TIFF."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ArgumentError(
            "pixels", "those of an image", "ones that OpenCV cannot decode", advice="are they cut short?"
        )
    channels = image.shape[2] if image.ndim == 3 else 1
    if image.dtype not in (np.uint8, np.uint16) or channels not in _TO_RGB:
        got = f"{image.dtype} in {channels}"
        raise ArgumentError("pixels", "8 or 16 bit integers in 1, 3 or 4 channels", got)
    return np.asarray(cv2.cvtColor(image, _TO_RGB[channels]))


def _decode_png(image: Opened, data: bytes) -> NDArray[np.uint8 | np.uint16]:
    """RGB or RGBA of a PNG."""
    bits = data[_PNG_BITS]
    clear = image.info.get("transparency")
    is_one_grey = isinstance(clear, int) and image.mode != "P"
    if is_one_grey:  # OpenCV passes it over, and Pillow does not spread its bits over 8, as it does those of pixels
        del image.info["transparency"]
    pixels = _decode_with_opencv(data) if bits == 16 else _decode_with_pillow(image)
    if not is_one_grey:
        return pixels
    maximum = np.iinfo(pixels.dtype).max
    clear = clear % 2**bits * (maximum // (2**bits - 1))  # its last bits count
    alpha = np.where(pixels[..., 0] == clear, 0, maximum)
    return np.dstack([pixels[..., :3], alpha.astype(pixels.dtype)])


def _decode_jpeg(image: Opened, data: bytes, end: int) -> NDArray[np.uint8]:
    """RGB of a JPEG, the header of whose first scan has this end. What lies behind the image is ignored."""
    if image.mode == "CMYK":
        raise ArgumentError("colours", "grey or RGB", "CMYK", advice="convert it to RGB")
    # Only progressive images use its last three bytes. In others some phones leave them 0, and decoders warn of it.
    if "progressive" not in image.info and data[end - 3 : end] == b"\0\0\0":
        data = data[: end - 3] + b"\0\x3f\0" + data[end:]
    return np.asarray(kornia_io.decode_image_jpegturbo(data, "rgb"))


def _decode_tiff(image: Opened, data: bytes) -> Image:
    """RGB or RGBA in [0, 1] of a TIFF, as stored, its colours not multiplied by alpha."""
    tags = image.tag_v2  # type: ignore[attr-defined]  # of TIFF only
    if lab := _LAB.get(int(tags.get(Base.PhotometricInterpretation, 2))):
        raise ArgumentError("colours", "grey or RGB", lab)
    orientation = int(tags.get(Base.Orientation, 1))
    samples = int(tags.get(Base.SamplesPerPixel, 1))
    alpha = tags.get(Base.ExtraSamples, (0,))[0]
    bits = max(tags.get(Base.BitsPerSample, (1,)))
    # Pillow leaves out a fourth sample of unspecified meaning and rounds when it divides colours by alpha.
    if tags.get(Base.PhotometricInterpretation) == _CMYK and bits <= 8 and samples == 4:
        pixels = _to_float(np.asarray(cmyk_to_rgb(image, image.info.get("icc_profile", b""))))
    elif bits <= 8 and (samples != 4 or alpha == _ALPHA):
        pixels = _to_float(_decode_with_pillow(image))
    else:
        pixels = _to_float(_decode_with_opencv(data))
        if tags.get(Base.PhotometricInterpretation) == _WHITE_IS_ZERO:  # which OpenCV passes over
            pixels[..., :3] = 1 - pixels[..., :3]
    if samples in (2, 4) and alpha == _MULTIPLIED_ALPHA:
        pixels[..., :3] = np.minimum(pixels[..., :3] / np.maximum(pixels[..., 3:], 1 / 65535), 1)
    # Both decoders turned the image upright: turn it back. 6 and 8 undo each other, all others undo themselves.
    return np.ascontiguousarray(turn(pixels, {6: 8, 8: 6}.get(orientation, orientation)))


def turn(image: NDArray[Any], orientation: int) -> NDArray[Any]:
    """An image `(H, W, K)` upright, as Exif's orientation from 1 to 8 says; a view where that is possible."""
    if orientation in (2, 4, 5, 7):  # mirrored: 2 alone, the others turned as 3, 6 and 8 are
        image = image[:, ::-1]
    return np.rot90(image, {3: 2, 4: 2, 5: 1, 6: 3, 7: 3, 8: 1}.get(orientation, 0))
