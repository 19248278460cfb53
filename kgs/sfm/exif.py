"""What a camera wrote beside the pixels: which way up the photo is, and how long the lens was.

Sources: Exif 2.32 (CIPA DC-008, 4.6), its place in JPEG (APP1), PNG (eXIf), WebP (EXIF) and TIFF; CIPA DCG-001 for the
length on 35 mm film, which compares diagonals. Nothing else is read, and what is damaged counts as not there.
"""

import math
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kgs.datasets.image_size import jpeg_markers, tiff_entries

FILM_DIAGONAL = math.hypot(36, 24)  # mm
_ORIENTATION, _IFD, _FOCAL, _FOCAL_35 = 0x0112, 0x8769, 0x920A, 0xA405
_PIXELS_X, _DENSITY, _DENSITY_UNIT = 0xA002, 0xA20E, 0xA210
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0}  # mm, in which the density of pixels is given
_FORMS = {3: "H", 4: "I", 5: "II"}


class Exif(NamedTuple):
    """Orientation from 1 (upright) to 8, and what the file says about the focal length; None where it does not."""

    orientation: int = 1
    focal_35mm: float | None = None  # in mm
    focal_over_width: float | None = None  # of the stored image, from the density of its pixels on the sensor

    def focal_ratio(self, width: int, height: int) -> float | None:
        """The focal length over the longer side of a photo of this shape, or None."""
        if self.focal_35mm:
            return self.focal_35mm / FILM_DIAGONAL * math.hypot(width, height) / max(width, height)
        stored = height if self.orientation > 4 else width
        return self.focal_over_width * stored / max(width, height) if self.focal_over_width else None


def read_exif(data: bytes) -> Exif:
    """The metadata of an image's bytes; the default where there are none that can be read."""
    try:
        return read_tiff(_block(data))
    except (struct.error, ValueError):
        return Exif()


def read_tiff(data: bytes) -> Exif:
    """The same of the metadata's own bytes, which are a TIFF."""
    try:
        tags = _tags(data)
    except (struct.error, ValueError):
        return Exif()
    orientation, focal, density = (int(tags.get(_ORIENTATION, 1)), tags.get(_FOCAL, 0.0), tags.get(_DENSITY, 0.0))
    width, unit = tags.get(_PIXELS_X, 0.0), _UNITS.get(int(tags.get(_DENSITY_UNIT, 2)), 0.0)
    ratio = focal * density / (unit * width) if unit and width else 0.0
    film = tags.get(_FOCAL_35, 0.0)
    return Exif(orientation if 1 <= orientation <= 8 else 1, film or None, ratio or None)


def turn(image: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """An image `(H, W, K)` upright, as the orientation says; a view where that is possible."""
    if orientation in (2, 4, 5, 7):  # mirrored: 2 alone, the others turned as 3, 6 and 8 are
        image = image[:, ::-1]
    return np.rot90(image, {3: 2, 4: 2, 5: 1, 6: 3, 7: 3, 8: 1}.get(orientation, 0))


def _block(data: bytes) -> bytes:
    """The metadata as a TIFF; a ValueError where there are none."""
    if data.startswith((b"II*\0", b"MM\0*")):
        return data
    if data.startswith(b"\xff\xd8"):
        for marker, at in jpeg_markers(data):
            if marker == 0xE1 and data[at + 2 : at + 8] == b"Exif\0\0":
                return data[at + 8 : at + struct.unpack_from(">H", data, at)[0]]
            if marker in (0xD9, 0xDA):
                break
        raise ValueError
    is_png = data.startswith(b"\x89PNG")
    at, name = (8, b"eXIf") if is_png else (12, b"EXIF")
    while at + 8 <= len(data) and (is_png or data.startswith(b"RIFF")):
        size, kind = struct.unpack_from(">I4s", data, at) if is_png else struct.unpack_from("<4sI", data, at)[::-1]
        if kind == name:
            return data[at + 8 : at + 8 + size].removeprefix(b"Exif\0\0")
        at += 12 + size if is_png else 8 + size + size % 2
    raise ValueError


def _tags(data: bytes) -> dict[int, float]:
    """The first number of each tag of the image and of its Exif directory."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None:
        raise ValueError
    tags: dict[int, float] = {}
    for directory in ("image", "exif"):
        start = struct.unpack_from(order + "I", data, 4)[0] if directory == "image" else int(tags.get(_IFD, 0))
        if not start:
            break
        for tag, (form, count, at) in tiff_entries(data, order, start, _FORMS):
            if count:
                number, divisor = (*struct.unpack_from(form, data, at), 1)[:2]
                tags.setdefault(tag, number / divisor if divisor else 0.0)
    return tags
