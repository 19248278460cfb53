"""Masks of photos: pictures whose white pixels are kept; `mask_files` finds them."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from kgs._support.errors import DataError

from .image_file import Image, ImageFile
from .images import Intrinsics
from .mask_files import MaskFiles


class Mask(NamedTuple):
    """The file that says which pixels of a photo are kept."""

    file: ImageFile

    def read(self, photo: Path, width: int, height: int) -> Image:
        """The share of each pixel of a photo that is kept, `(height, width)` in [0, 1].

        White is the largest value of the mask, as some have 0 and 1, or 16 bits up to 255.

        Raises:
            DataError: the file cannot be read, has another shape than the photo, or one value that is not white.
        """
        pixels = self.file.read()
        values = pixels[..., :3].mean(axis=2) * (pixels[..., 3] if pixels.shape[2] == 4 else 1.0)
        rows, columns = values.shape
        if not Intrinsics(columns, rows, 1, 1, 0, 0).same_aspect(width, height):
            expected = f"the shape of {photo.name}, {width}x{height}"
            raise DataError(self.file.path, "", expected, f"{columns}x{rows}")
        white = float(values.max())
        if values.min() == white < 1:
            value = white * (2 ** max(8, self.file.metadata.bits) - 1)
            raise DataError(self.file.path, "", "black and white pixels", f"the value {value:g} everywhere")
        kept = np.asarray(values > 0.5 * white, np.float32)
        if (columns, rows) == (width, height):
            return kept
        return np.asarray(cv2.resize(kept, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def as_masks(files: MaskFiles) -> dict[Path, Mask]:
    """Masks by their photos."""
    return {photo: Mask(ImageFile(path)) for photo, path in files.masks.items()}
