"""HEIC photos, as Apple's phones take them, read by pi-heif (extra `heic`): a decoder, nothing else."""

import io
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

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

    def opened(use: Callable[[Any], Any]) -> Any:
        try:
            return use(pi_heif.open_heif(io.BytesIO(data)))
        except _FAULTS as error:
            raise DataError(path, "", f"the HEIC photo cannot be decoded ({error})") from error

    exif, (width, height) = opened(lambda photo: (photo.info.get("exif") or b"", photo.size))
    check_size(path, width, height, len(data))

    def read() -> NDArray[np.float32]:
        pixels = opened(np.array)  # opened anew, and copied: the decoder keeps what it has decoded
        pixels = pixels if pixels.ndim == 3 else np.stack([pixels] * 3, axis=2)
        return np.asarray(pixels / np.float32(255), np.float32)

    return read_tiff(exif.removeprefix(b"Exif\0\0"))._replace(orientation=1), (width, height), read
