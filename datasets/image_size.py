"""The size that an image's header claims, read without decoding it: the defence against decompression bombs.

Sources: PNG (ISO 15948, 11.2.1), JPEG (ITU T.81, B.2), WebP (RFC 9649), BMP (Windows' BITMAPCOREHEADER and
BITMAPINFOHEADER), TIFF 6.0 (section 2).
"""

from __future__ import annotations

import struct
from pathlib import Path

from kgs.errors import DataError

__all__ = ["image_size"]

_MOST_PIXELS = 2**28
# A plain grey PNG has 1032 pixels a byte, a photo fewer than 100; small images may be as plain as they like.
_MOST_PIXELS_PER_BYTE, _ALWAYS_ALLOWED = 2048, 2**20


def image_size(path: Path, data: bytes) -> tuple[int, int]:
    """Width and height as the header of a PNG, JPEG, WebP, BMP or TIFF image says.

    Args:
        path: named in errors.
        data: the file's bytes.

    Raises:
        DataError: it is none of these formats, its header is cut short, or decoding would take memory out of all
            proportion to the file: over 2^28 pixels, or over 2048 pixels a byte where there are more than 2^20.
    """
    read = next((read for signature, read in _READERS if data.startswith(signature)), None)
    if read is None:
        raise DataError(path, "", "cannot be decoded: expected a PNG, JPEG, WebP, BMP or TIFF image")
    try:
        width, height, *tile = read(data)
    except (struct.error, IndexError, ValueError) as error:
        raise DataError(path, "header", "cannot be decoded: the image's header is damaged or cut short") from error
    if width < 1 or height < 1:
        raise DataError(path, "header", f"expected an image of at least 1x1 pixels, got {width}x{height}")
    most = min(_MOST_PIXELS, max(_ALWAYS_ALLOWED, _MOST_PIXELS_PER_BYTE * len(data)))
    for wide, high in ((width, height), tile or (1, 1)):
        if wide * high > most:
            raise DataError(
                path, "header", f"claims {wide}x{high} pixels in {len(data)} bytes: a decompression bomb, not decoded"
            )
    return width, height


def _png(data: bytes) -> tuple[int, ...]:
    """Every chunk has to be in the file: decoders take memory for what its length says."""
    if data[12:16] != b"IHDR":
        raise ValueError
    at = 8
    while data[at + 4 : at + 8] != b"IEND":
        at += 12 + struct.unpack_from(">I", data, at)[0]
    return struct.unpack_from(">II", data, 16)


def _jpeg(data: bytes) -> tuple[int, ...]:
    """Walk from marker to marker, as a decoder does, to the start of the frame."""
    at = 2
    while True:
        at = data.index(b"\xff", at)
        while data[at] == 0xFF:
            at += 1
        marker, at = data[at], at + 1
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 3)
            return width, height
        if marker in (0xD9, 0xDA):
            raise ValueError
        if marker not in (0x00, 0x01, *range(0xD0, 0xD9)):  # those have no length behind them
            at += struct.unpack_from(">H", data, at)[0]


def _webp(data: bytes) -> tuple[int, ...]:
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


def _bmp(data: bytes) -> tuple[int, ...]:
    if struct.unpack_from("<I", data, 14)[0] == 12:
        return struct.unpack_from("<HH", data, 18)
    width, height = struct.unpack_from("<ii", data, 18)
    return width, abs(height)  # below 0: rows from top to bottom


def _tiff(data: bytes) -> tuple[int, ...]:
    """The size of the first image, and that of its tiles, which are decoded whole."""
    order = "<" if data[:1] == b"I" else ">"
    start = struct.unpack_from(f"{order}I", data, 4)[0]
    sizes = dict.fromkeys((256, 257, 322, 323), 0)
    for i in range(struct.unpack_from(f"{order}H", data, start)[0]):
        tag, kind = struct.unpack_from(f"{order}HH", data, start + 2 + 12 * i)
        if tag in sizes and kind in (3, 4):
            form = "H" if kind == 3 else "I"
            sizes[tag] = max(sizes[tag], struct.unpack_from(order + form, data, start + 10 + 12 * i)[0])
    return tuple(sizes.values())


_READERS = (
    (b"\x89PNG\r\n\x1a\n", _png),
    (b"\xff\xd8", _jpeg),
    (b"RIFF", _webp),
    (b"BM", _bmp),
    (b"II*\0", _tiff),
    (b"MM\0*", _tiff),
)
