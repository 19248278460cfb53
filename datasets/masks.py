"""Masks of photos: pictures whose white pixels are kept, found by their names and folders.

Masks lie in `masks/` in the scene's folder, beside the photos or between, or in the folder that the user names. One has
the photo's stem or whole name (as COLMAP writes it) before its ending; in a folder of masks, photos of subfolders may
have theirs in subfolders of the same names. All else that is named like a mask is not used, and named in a line.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from kgs._support.errors import DataError, listed

from .folders import IMAGE_SUFFIXES, MASKS, MASKS_ARE_IN, PICTURE_SUFFIXES, is_like_mask, list_images, list_pictures
from .image_file import Image, ImageFile
from .images import Intrinsics

_SUFFIXES = (*PICTURE_SUFFIXES, ".npy", ".npz")


class Mask(ImageFile):
    """The file that says which pixels of a photo are kept."""

    def kept(self, photo: Path, width: int, height: int) -> Image:
        """The share of each pixel of a photo that is kept, `(height, width)` in [0, 1].

        White is the largest value of the mask, as some have 0 and 1, or 16 bits up to 255.

        Raises:
            DataError: the file cannot be read, has another shape than the photo, or one value that is not white.
        """
        pixels = self.read()
        values = pixels[..., :3].mean(axis=2) * (pixels[..., 3] if pixels.shape[2] == 4 else 1.0)
        rows, columns = values.shape
        if not Intrinsics(columns, rows, 1, 1, 0, 0).same_aspect(width, height):
            raise DataError(self.path, "", f"the shape of {photo.name}, {width}x{height}", f"{columns}x{rows}")
        white = float(values.max())
        if values.min() == white < 1:
            value = white * (2 ** max(8, self.metadata.bits) - 1)
            raise DataError(self.path, "", "black and white pixels", f"the value {value:g} everywhere")
        kept = np.asarray(values > 0.5 * white, np.float32)
        if (columns, rows) == (width, height):
            return kept
        return np.asarray(cv2.resize(kept, (width, height), interpolation=cv2.INTER_AREA), np.float32)


class MaskFiles(NamedTuple):
    """The masks of photos, by photo, and what is named like masks and not used."""

    masks: dict[Path, Path]
    lost: list[Path]  # in folders of masks: of photos that are not there, or no pictures that can be read
    unused: list[Path]  # pictures beside photos, and folders

    def of(self, photo: Path) -> Mask | None:
        """The mask of a photo, if it has one."""
        return Mask(self.masks[photo]) if photo in self.masks else None

    def notes(self, root: Path) -> list[str]:
        """A sentence each about files that fit no photo and others that are not used."""
        lost, unused = (
            listed([path.relative_to(root) if path.is_relative_to(root) else path for path in paths])
            for paths in (self.lost, self.unused)
        )
        notes = [f"masks that fit no photo of the scene: {len(self.lost)} ({lost})"] if self.lost else []
        return notes + ([f"named like masks and not used: {unused}: {MASKS_ARE_IN}"] if self.unused else [])


def find_masks(photos: Sequence[Path], root: Path, folder: Path | None = None) -> MaskFiles:
    """The masks of a scene's photos.

    Args:
        photos: the photos whose masks are looked for.
        root: the scene's folder.
        folder: the only folder of masks, if the user names one.

    Raises:
        DataError: the folder does not exist; a folder of masks has files, and none fits a photo; a mask fits several
            photos, or two fit one.
    """
    if folder is not None and not folder.is_dir():
        raise DataError(folder, "", "a folder of masks", "no such folder")
    parents = sorted({photo.parent for photo in photos})
    between = {outer for parent in parents for outer in parent.parents if outer.is_relative_to(root)}
    outer_folders = sorted({root, *parents, *between})
    folders = [outer / MASKS for outer in outer_folders if (outer / MASKS).is_dir() and outer / MASKS not in parents]
    masks = dict[Path, Path]()
    lost = list[Path]()
    for inner in folders if folder is None else [folder]:
        own = [photo for photo in photos if folder or inner.parent == root or photo.is_relative_to(inner.parent)]
        files = [path for path in sorted(inner.rglob("*")) if path.suffix.lower() in _SUFFIXES and path.name[0] != "."]
        found = fitting(inner, [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES], own, "mask")
        if not found and (files or folder):
            got = listed([path.relative_to(inner) for path in files]) or "nothing"
            raise DataError(inner, "", "pictures with the stems or names of photos", got)
        for mask, photo in found.items():
            if photo in masks:
                raise DataError(mask, "", f"one mask of {photo.name}", f"{masks[photo]} too")
            masks[photo] = mask
        lost += [path for path in files if path not in found]
    known = {*photos, *masks.values(), *lost}
    unused = list[Path]()
    for parent in filter(Path.is_dir, parents):
        taken = {*list_images(parent, PICTURE_SUFFIXES)}
        pictures = [path for path in list_pictures(parent, PICTURE_SUFFIXES) if path not in known]
        unused += [path for path in pictures if path not in taken or is_like_mask(path)]
    if folder is None:
        inner_folders = [path for outer in outer_folders if outer.is_dir() for path in sorted(outer.iterdir())]
        like = [path for path in inner_folders if is_like_mask(path) and path.name != MASKS and path.is_dir()]
        pictures_in = [path for path in like if any(file.suffix.lower() in _SUFFIXES for file in path.rglob("*"))]
        unused += [path for path in pictures_in if path not in outer_folders]
    return MaskFiles(masks, lost, unused)


def fitting(folder: Path, files: Iterable[Path], photos: Iterable[Path], what: str) -> dict[Path, Path]:
    """The photos of the files in a folder and its subfolders, by file; those that fit no photo are left out.

    A file has the stem of its photo, or the whole name, before its ending. `what` it is, errors say.

    Raises:
        DataError: a file fits several photos.
    """
    by_name = dict[str, list[Path]]()
    for photo in photos:
        for name in {photo.name.lower(), photo.stem.lower()}:
            by_name.setdefault(name, []).append(photo)
    found = dict[Path, Path]()
    for file in files:
        inner = _lower(file.parent.relative_to(folder))
        alike = by_name.get(file.stem.lower(), [])
        matches = [photo for photo in alike if _lower(photo.parent)[-len(inner) :] == inner or not inner]
        if len(matches) > 1:
            raise DataError(file, "", f"a {what} of one photo", f"one that fits {matches[0]} and {matches[1]}")
        if matches:
            found[file] = matches[0]
    return found


def _lower(path: Path) -> tuple[str, ...]:
    return tuple(part.lower() for part in path.parts)
