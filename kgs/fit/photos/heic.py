"""HEIC photos, as Apple's phones take them, read by pi-heif (extra `heic`): a decoder, nothing else."""

import io
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kgs.datasets.image_size import check_size
from kgs.errors import DataError

from .exif import Exif, read_tiff

SUFFIXES = (".heic", ".heif", ".hif")
_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
_FAULTS = (EOFError, OSError, RuntimeError, SyntaxError, ValueError)  # of pi-heif


def can_read_heic() -> bool:
    """Whether pi-heif is there."""
    return find_spec("pi_heif") is not None


def is_heic(data: bytes) -> bool:
    """Whether these are the bytes of a HEIC photo."""
    return data[4:8] == b"ftyp" and data[8:12] in _BRANDS


def open_heic(path: Path, data: bytes) -> tuple[Exif, tuple[int, int], Callable[[], NDArray[np.float32]]]:
    """What a HEIC photo says of its lens, its width and height, and what reads its pixels, as `read_image` does.

    Convention:
        Upright: the file itself says how its pixels are turned, and an orientation in its Exif is for others.

    Raises:
        DataError: the file is damaged.
        ModuleNotFoundError: pi-heif is not installed.
    """
    import pi_heif

    def failed(error: Exception) -> DataError:
        return DataError(path, "", f"the HEIC photo cannot be decoded ({error})")

    try:
        photo = pi_heif.open_heif(io.BytesIO(data))
        exif = (photo.info.get("exif") or b"").removeprefix(b"Exif\0\0")
    except _FAULTS as error:
        raise failed(error) from error
    width, height = photo.size
    check_size(path, width, height, len(data))

    def read() -> NDArray[np.float32]:
        try:
            pixels = np.asarray(photo)
        except _FAULTS as error:
            raise failed(error) from error
        pixels = pixels if pixels.ndim == 3 else np.stack([pixels] * 3, axis=2)
        return np.asarray(pixels / np.float32(255), np.float32)

    return read_tiff(exif)._replace(orientation=1), (width, height), read
