"""What an image's bytes say before they are decoded: its size, whether it is whole, how its pixels are stored.

Sources: PNG (ISO 15948, 11.2.1), JPEG (ITU T.81, B.2), WebP (RFC 9649), BMP (Windows' BITMAPCOREHEADER and
BITMAPINFOHEADER), TIFF 6.0 (sections 2, 8 and 18).
"""

import mmap
import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path

from kgs.errors import DataError

Buffer = bytes | mmap.mmap
_WIDTH, _HEIGHT, _ORIENTATION, _SAMPLES, _TILE_WIDTH, _TILE_HEIGHT, _EXTRA_SAMPLES = 256, 257, 274, 277, 322, 323, 338
_MARKER = re.compile(rb"\xff([^\x00\x01\xd0-\xd7\xff])")  # JPEG's; those without length are passed over


def image_size(path: Path, data: Buffer) -> tuple[int, int]:
    """Width and height as an image's header says; a DataError about `path` where it should not be decoded."""
    read = next((read for signature, read in _READERS.items() if data[: len(signature)] == signature), None)
    if read is None:
        raise DataError(path, "", "cannot be decoded: expected a PNG, JPEG, WebP, BMP or TIFF image")
    try:
        width, height, *tile = read(data)
    except (struct.error, IndexError, ValueError) as error:
        raise DataError(path, "header", "cannot be decoded: the image's header is damaged or cut short") from error
    for wide, high in [(width, height), *([tile] if tile and all(tile) else [])]:
        check_size(path, wide, high, len(data))
    return width, height


def check_size(path: Path, width: int, height: int, size: int) -> None:
    """A DataError about `path`, a file of `size` bytes, where so many pixels should not be decoded."""
    if width < 1 or height < 1:
        raise DataError(path, "header", f"expected an image of at least 1x1 pixels, got {width}x{height}")
    # Photos have fewer than 20 pixels per byte, a plain PNG 1032. Any file may have 2^21 (48 MiB while decoded), plain
    # images 2^24 (384 MiB); more, up to 2^28, need a byte for every 32.
    if width * height > min(2**28, max(2**21, min(2**24, 2048 * size), 32 * size)):
        raise DataError(path, "header", f"claims {width}x{height} pixels in {size} bytes: a decompression bomb")


def plain_jpeg(data: bytes) -> bytes:
    """A JPEG up to the end of its first image, behind which some phones put a video; a ValueError without that end.

    Scan parameters that only progressive images need are set right in others: some phones leave them 0.
    """
    parts, sequential = bytearray(data), False
    for marker, at in jpeg_markers(data):
        if marker in (0xC0, 0xC1):
            sequential = True
        elif marker == 0xDA and sequential:
            end = at + struct.unpack_from(">H", data, at)[0]
            parts[end - 3 : end] = b"\0\x3f\0"
        elif marker == 0xD9:
            return bytes(parts[:at])
    raise ValueError("the JPEG ends before its image does (a truncated file?)")


def plain_tiff(data: bytes) -> tuple[bytes, bool]:
    """A TIFF whose pixels decoders give as they are stored, and whether these are multiplied by their alpha.

    Decoders turn an image as its orientation tag says, and multiply 8 bit colours by an alpha that is not multiplied
    in. Both tags are overwritten. A grey TIFF with an alpha channel, which decoders leave out, is a ValueError.
    """
    tags, order, parts = _tags(data), "<" if data[:1] == b"I" else ">", bytearray(data)
    if _ORIENTATION in tags:
        struct.pack_into(order + "H", parts, tags[_ORIENTATION][1], 1)
    if _EXTRA_SAMPLES not in tags:
        return bytes(parts), False
    if tags.get(_SAMPLES, (1, 0))[0] == 2:
        raise ValueError("is a grey TIFF with an alpha channel, which cannot be read: store it as RGBA or as PNG")
    kind, at = tags[_EXTRA_SAMPLES]
    struct.pack_into(order + "H", parts, at, min(kind, 1))
    return bytes(parts), kind == 1


def _png(data: Buffer) -> tuple[int, ...]:
    """Every chunk has to be in the file: decoders take memory for what its length says."""
    if data[12:16] != b"IHDR":
        raise ValueError
    at = 8
    while data[at + 4 : at + 8] != b"IEND":
        at += 12 + struct.unpack_from(">I", data, at)[0]
    return struct.unpack_from(">II", data, 16)


def _jpeg(data: Buffer) -> tuple[int, ...]:
    for marker, at in jpeg_markers(data):
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 3)
            return width, height
        if marker in (0xD9, 0xDA):
            break
    raise ValueError


def jpeg_markers(data: Buffer) -> Iterator[tuple[int, int]]:
    """A JPEG's markers and where what follows each begins; the coded data behind a scan's header are passed over."""
    at = 2
    while found := _MARKER.search(data, at):
        marker, at = found[1][0], found.end()
        del found  # it would keep a mapped file open
        yield marker, at
        if marker not in (0xD8, 0xD9):  # they have no length behind them either
            at += struct.unpack_from(">H", data, at)[0]


def _webp(data: Buffer) -> tuple[int, ...]:
    kind = data[8:16]
    if kind == b"WEBPVP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"WEBPVP8L" and data[20] == 0x2F:
        bits = struct.unpack_from("<I", data, 21)[0]
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"WEBPVP8 " and data[23:26] == b"\x9d\x01\x2a":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    raise ValueError


def _bmp(data: Buffer) -> tuple[int, ...]:
    if struct.unpack_from("<I", data, 14)[0] == 12:
        return struct.unpack_from("<HH", data, 18)
    width, height = struct.unpack_from("<ii", data, 18)
    return width, abs(height)  # below 0: rows from top to bottom


def _tiff(data: Buffer) -> tuple[int, ...]:
    """The size of the first image, and that of its tiles, which are decoded whole."""
    tags = _tags(data)
    return tuple(tags.get(tag, (0, 0))[0] for tag in (_WIDTH, _HEIGHT, _TILE_WIDTH, _TILE_HEIGHT))


def _tags(data: Buffer) -> dict[int, tuple[int, int]]:
    """The first image's tags that are whole numbers: the first value of each, and where it stands in the file."""
    order = "<" if data[:1] == b"I" else ">"
    start = struct.unpack_from(f"{order}I", data, 4)[0]
    tags: dict[int, tuple[int, int]] = {}
    for tag, (form, _, at) in tiff_entries(data, order, start, {3: "H", 4: "I"}):
        # of a tag that occurs twice the larger value counts, so that no size is larger than it seems
        tags[tag] = max(tags.get(tag, (0, 0)), (struct.unpack_from(form, data, at)[0], at))
    return tags


def tiff_entries(
    data: Buffer, order: str, start: int, forms: Mapping[int, str]
) -> Iterator[tuple[int, tuple[str, int, int]]]:
    """The entries of a TIFF's directory whose kind has a form: tag, form of a value, how many, and where they stand."""
    for at in range(start + 2, start + 2 + 12 * struct.unpack_from(f"{order}H", data, start)[0], 12):
        tag, kind, count = struct.unpack_from(f"{order}HHI", data, at)
        if kind in forms:
            form = order + forms[kind]
            inside = count * struct.calcsize(form) <= 4
            yield tag, (form, count, at + 8 if inside else struct.unpack_from(f"{order}I", data, at + 8)[0])


_TIFF = {b"II*\0": _tiff, b"MM\0*": _tiff}
_READERS = {b"\x89PNG\r\n\x1a\n": _png, b"\xff\xd8": _jpeg, b"RIFF": _webp, b"BM": _bmp, **_TIFF}
