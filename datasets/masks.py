"""Masks of photos: pictures that say which pixels are kept; `mask_files` finds them.

White is kept. instant-ngp's `dynamic_mask_*.png` beside the photos are the other way round: what is not black there
moves, and is not kept.
"""

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
    keeps_white: bool = True

    def read(self, photo: Path, width: int, height: int) -> Image:
        """The share of each pixel of a photo that is kept, `(height, width)` in [0, 1].

        Raises:
            DataError: the file cannot be read, has another shape than the photo, or keeps nothing.
        """
        pixels = self.file.read()
        kept = pixels[..., :3].mean(axis=2) * (pixels[..., 3] if pixels.shape[2] == 4 else 1.0)
        kept = np.asarray(kept > 0.5 if self.keeps_white else kept == 0, np.float32)
        rows, columns = kept.shape
        if not Intrinsics(columns, rows, 1, 1, 0, 0).same_aspect(width, height):
            expected = f"the shape of {photo.name}, {width}x{height}"
            raise DataError(self.file.path, "", expected, f"{columns}x{rows}")
        if not kept.any():
            raise DataError(self.file.path, "", f"pixels of {photo.name} that are kept", "none")
        if (columns, rows) == (width, height):
            return kept
        return np.asarray(cv2.resize(kept, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def as_masks(files: MaskFiles) -> dict[Path, Mask]:
    """Masks by their photos."""
    moving = {photo: Mask(ImageFile(path), keeps_white=False) for photo, path in files.moving.items()}
    return moving | {photo: Mask(ImageFile(path)) for photo, path in files.keeping.items()}
