"""Masks of photos: pictures beside them that say which pixels are kept.

A mask has the photo's stem (or its whole name before the ending, as COLMAP writes them), alone or with `_mask` behind
it or `mask_` before it, and lies in `masks/`, in a folder that the user names, or where a layout's file says; those of
photos in subfolders may lie in subfolders of the same names. One whose name says that it is a mask may lie beside its
photo. White is kept. instant-ngp's `dynamic_mask_*.png` beside the photos are the other way round: what is not
black there moves, and is not kept.

Sources: https://docs.nerf.studio/quickstart/data_conventions.html (masks); instant-ngp, docs/nerf_dataset_tips.md.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from kgs.errors import DataError

from .folders import MASK_FILES, list_images, list_pictures, mask_folders, masks_beside, photo_of_mask
from .image_file import Image, ImageFile
from .images import Intrinsics


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
            reason = f"expected the shape of {photo.name}, {width}x{height}, got {columns}x{rows}"
            raise DataError(self.file.path, "", reason)
        if not kept.any():
            raise DataError(self.file.path, "", f"expected pixels of {photo.name} that are kept, got none")
        if (columns, rows) == (width, height):
            return kept
        return np.asarray(cv2.resize(kept, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def mask_folder(root: Path, photos: Sequence[Path]) -> Path | None:
    """The folder of masks beside a scene's photos or their folder, None if there is none with a picture in it."""
    places = dict.fromkeys([root, *sorted({photo.parent for photo in photos})])
    return next((folder for folder in mask_folders(places) if _pictures(folder, photos)), None)


def find_masks(photos: Sequence[Path], folder: Path | None) -> dict[Path, Mask]:
    """The masks of photos: those in a folder, and those beside photos that have none there.

    Raises:
        DataError: the folder does not exist, or holds no masks, one that fits no photo or several, or two that fit one.
    """
    found = {photo: Mask(ImageFile(beside), keeps_white=False) for photo in photos if (beside := _dynamic(photo))}
    found |= _beside(photos)
    if folder is None:
        return found
    if not folder.is_dir():
        raise DataError(folder, "", "expected a folder of masks, found no such folder")
    masks = _pictures(folder, photos)
    if not masks:
        raise DataError(folder, "", "expected masks, pictures with the stems of the photos, found none")
    by_name = _by_name(photos)
    beside = _by_name(
        photo for place in {photo.parent for photo in photos} if place.is_dir() for photo in list_images(place)
    )
    named: dict[Path, Path] = {}
    for mask in masks:
        fitting = _fitting(mask, by_name, folder)
        if len(fitting) > 1:
            raise DataError(mask, "", f"expected a mask of one photo, it fits {fitting[0]} and {fitting[1]}")
        if not fitting and not _fitting(mask, beside, folder):
            raise DataError(mask, "", "fits no photo: expected the stem of one, as IMG_1.png for IMG_1.jpg")
        for photo in fitting:
            if photo in named:
                raise DataError(mask, "", f"expected one mask of {photo.name}, got {named[photo].name} too")
            named[photo] = mask
    return found | {photo: Mask(ImageFile(mask)) for photo, mask in named.items()}


def _pictures(folder: Path, photos: Sequence[Path]) -> list[Path]:
    """The masks of a folder, and of folders in it that have the names of the photos' folders."""
    parts = {photo.parent.parts for photo in photos}
    inner = {Path(*names[-depth:]) for names in parts for depth in (1, 2) if len(names) > depth}
    places = [folder, *sorted(folder / names for names in inner if (folder / names).is_dir())]
    return [mask for place in places for mask in list_pictures(place)]


def _beside(photos: Sequence[Path]) -> dict[Path, Mask]:
    """The masks that lie among the photos and say by their names that they are."""
    found = dict[Path, Path]()
    known = set(photos)
    for place in filter(Path.is_dir, sorted({photo.parent for photo in photos})):
        for mask, photo in masks_beside(place).items():
            if photo not in known or mask in known:
                continue
            if photo in found:
                raise DataError(mask, "", f"expected one mask of {photo.name}, got {found[photo].name} too")
            found[photo] = mask
    return {photo: Mask(ImageFile(mask)) for photo, mask in found.items()}


def _by_name(photos: Iterable[Path]) -> dict[str, list[Path]]:
    """Photos by their names and their stems, in lower case."""
    found = dict[str, list[Path]]()
    for photo in photos:
        for name in {photo.name.lower(), photo.stem.lower()}:
            found.setdefault(name, []).append(photo)
    return found


def _fitting(mask: Path, photos: dict[str, list[Path]], folder: Path) -> list[Path]:
    """The photos that a mask in a folder of masks fits by its name and inner folder."""
    inner = mask.parent.relative_to(folder).parts
    named = dict.fromkeys(
        photo for name in (mask.stem.lower(), photo_of_mask(mask)[0]) for photo in photos.get(name, ())
    )
    return [photo for photo in named if photo.parent.parts[len(photo.parent.parts) - len(inner) :] == inner]


def _dynamic(photo: Path) -> Path | None:
    path = photo.with_name(f"{MASK_FILES}{photo.stem}.png")
    return path if path.is_file() else None
