"""Which files are the masks of photos, judged by their names and folders; loads neither NumPy nor torch.

A mask has the photo's stem (or its whole name before the ending, as COLMAP writes them), alone or with `_mask` behind
it or `mask_` before it, and lies in `masks/` or `mask/` beside the photo, beside one of the folders that it is in, or
in a folder that the user names. Masks of photos in subfolders may lie in subfolders of the same names. One whose name
says that it is a mask may lie beside its photo, and so may instant-ngp's `dynamic_mask_*.png`.

Sources: https://docs.nerf.studio/quickstart/data_conventions.html (masks); instant-ngp, docs/nerf_dataset_tips.md.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from kgs._support.errors import DataError, listed

from .folders import (
    IMAGE_SUFFIXES,
    MASK_FILES,
    MASKS_ARE_IN,
    UNREADABLE_SUFFIXES,
    is_like_mask,
    list_images,
    list_pictures,
    mask_folders,
    masks_beside,
    photo_of_mask,
)

_SUFFIXES = (*IMAGE_SUFFIXES, *UNREADABLE_SUFFIXES, ".npy", ".npz")


class MaskFiles(NamedTuple):
    """The masks of photos, by photo, and what is not used where masks may lie."""

    keeping: dict[Path, Path]  # white is kept
    moving: dict[Path, Path]  # instant-ngp's: black is kept
    unused: list[Path]  # files that fit no photo or are of one that has a mask, and folders that are named like masks

    def notes(self, root: Path, max_names: int) -> list[str]:
        """A sentence that names up to `max_names` files that are not used, relative to the scene's folder; or []."""
        names = [path.relative_to(root) if path.is_relative_to(root) else path for path in self.unused]
        return [f"named like masks and not used: {listed(names, max_names)}: {MASKS_ARE_IN}"] if names else []


def find_mask_files(photos: Sequence[Path], root: Path, folder: Path | None = None) -> MaskFiles:
    """The masks of a scene's photos: those in folders of masks first, then those beside the photos.

    Args:
        photos: the photos whose masks are looked for.
        root: the scene's folder.
        folder: the only folder of masks, if the user names one.

    Raises:
        DataError: the folder does not exist or holds no masks; or in it, or the first folder of masks that holds any,
            one fits no photo or several, or two fit one. Of other folders such masks are not used.
    """
    if folder is not None and not folder.is_dir():
        raise DataError(folder, "", "a folder of masks", "no such folder")
    parents = [parent for parent in sorted({photo.parent for photo in photos}) if parent.is_dir()]
    on_disk = _by_name(photo for parent in parents for photo in list_images(parent))
    outer_folders = _outer_folders(root, parents)
    searched = {only: photos for only in [folder] if only is not None} or {
        inner: [photo for photo in photos if outer == root or photo.is_relative_to(outer)]
        for outer in outer_folders
        for inner in mask_folders([outer])
        if inner not in parents
    }
    keeping = dict[Path, Path]()
    unused = list[Path]()
    is_strict = True
    for searched_folder, own in searched.items():
        masks, others = _pictures(searched_folder, own)
        if folder is not None and not masks:
            raise DataError(folder, "", "masks, pictures with the stems of the photos", "none")
        found, rejected = _of_folder(searched_folder, masks, own, on_disk, is_strict)
        is_strict = is_strict and not masks
        unused += [*others, *rejected, *(mask for photo, mask in found.items() if photo in keeping)]
        keeping = found | keeping
    beside = _beside(photos, parents)
    unused += [mask for photo, mask in beside.items() if photo in keeping]
    keeping = beside | keeping
    paths = {photo: photo.with_name(f"{MASK_FILES}{photo.stem}.png") for photo in photos}
    moving = {photo: path for photo, path in paths.items() if path.is_file()}
    unused += [path for photo, path in moving.items() if photo in keeping]
    moving = {photo: path for photo, path in moving.items() if photo not in keeping}
    unused += _like_masks_beside(photos, parents, on_disk)
    if folder is None:
        unused += _like_mask_folders(outer_folders, {photo for photo in photos if photo not in keeping | moving})
    return MaskFiles(keeping, moving, unused)


def _outer_folders(root: Path, parents: Sequence[Path]) -> list[Path]:
    """The scene's folder, those of its photos, and those between."""
    between = [outer for parent in parents if parent.is_relative_to(root) for outer in parent.parents]
    inside = sorted({path for path in [*parents, *between] if path.is_relative_to(root)})
    return [*dict.fromkeys([root, *inside, *parents])]


def _pictures(folder: Path, photos: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """The masks in a folder and in folders in it that have the names of the photos' folders; and what else may be."""
    parents = {_lower(photo.parent) for photo in photos}
    masks = list[Path]()
    others = list[Path]()
    for directory, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        inner = _lower(Path(directory).relative_to(folder))
        is_read = any(_ends(parent, inner) for parent in parents)
        for name in sorted(files):
            path = Path(directory, name)
            if path.suffix.lower() in _SUFFIXES and not name.startswith("."):
                (masks if is_read and path.suffix.lower() in IMAGE_SUFFIXES else others).append(path)
    return masks, others


def _of_folder(
    folder: Path, masks: Sequence[Path], photos: Sequence[Path], on_disk: dict[str, list[Path]], is_strict: bool
) -> tuple[dict[Path, Path], list[Path]]:
    """The masks of a folder by their photos, and those that fit none of the files on disk, several, or one twice."""
    by_name = _by_name(photos)
    found = dict[Path, Path]()
    rejected = list[Path]()
    for mask in masks:
        fitting = _fitting(mask, by_name, folder)
        wrong = None
        if len(fitting) > 1:
            wrong = ("a mask of one photo", f"one that fits {fitting[0]} and {fitting[1]}")
        elif not fitting and not _fitting(mask, on_disk, folder):
            wrong = ("the stem of a photo, as IMG_1.png for IMG_1.jpg", "that of none")
        elif fitting and fitting[0] in found:
            wrong = (f"one mask of {fitting[0].name}", f"{found[fitting[0]].name} too")
        elif fitting:
            found[fitting[0]] = mask
        if wrong and is_strict:
            raise DataError(mask, "", *wrong)
        if wrong:
            rejected.append(mask)
    return found, rejected


def _by_name(photos: Iterable[Path]) -> dict[str, list[Path]]:
    """Photos by their names and their stems, in lower case."""
    found = dict[str, list[Path]]()
    for photo in photos:
        for name in {photo.name.lower(), photo.stem.lower()}:
            found.setdefault(name, []).append(photo)
    return found


def _fitting(mask: Path, photos: dict[str, list[Path]], folder: Path) -> list[Path]:
    """The photos that a mask in a folder of masks fits by its name and inner folder."""
    inner = _lower(mask.parent.relative_to(folder))
    names = mask.stem.lower(), photo_of_mask(mask)[0]
    named = dict.fromkeys(photo for name in names for photo in photos.get(name, ()))
    return [photo for photo in named if _ends(_lower(photo.parent), inner)]


def _lower(path: Path) -> tuple[str, ...]:
    return tuple(part.lower() for part in path.parts)


def _ends(parts: tuple[str, ...], end: tuple[str, ...]) -> bool:
    return parts[len(parts) - len(end) :] == end


def _beside(photos: Sequence[Path], parents: Sequence[Path]) -> dict[Path, Path]:
    """The masks that lie among the photos and say by their names that they are."""
    found = dict[Path, Path]()
    known = set(photos)
    for parent in parents:
        for mask, photo in masks_beside(parent).items():
            if photo not in known or mask in known:
                continue
            if photo in found:
                raise DataError(mask, "", f"one mask of {photo.name}", f"{found[photo].name} too")
            found[photo] = mask
    return found


def _like_masks_beside(photos: Sequence[Path], parents: Sequence[Path], on_disk: dict[str, list[Path]]) -> list[Path]:
    """Pictures among the photos, but none of them, that are named like masks of no photo there."""
    known = set(photos)
    like = [path for parent in parents for path in list_images(parent) if is_like_mask(path) and path not in known]
    dynamic = [path for parent in parents for path in sorted(parent.glob(f"{MASK_FILES}*"))]
    return like + [
        path
        for path in dynamic
        if path.suffix.lower() in _SUFFIXES
        and (path.suffix != ".png" or path.stem.removeprefix(MASK_FILES).lower() not in on_disk)
    ]


def _like_mask_folders(outer_folders: Sequence[Path], photos: set[Path]) -> list[Path]:
    """Folders that are named like masks, but not as `mask_folders`, and hold pictures named as one of these photos."""
    stems = {photo.stem.lower() for photo in photos}
    folders = [
        path for outer in filter(Path.is_dir, outer_folders) for path in sorted(outer.iterdir()) if path.is_dir()
    ]
    known = {*outer_folders, *mask_folders(outer_folders)}
    like = [path for path in folders if is_like_mask(path) and path not in known]
    return [path for path in like if any(photo_of_mask(picture)[0] in stems for picture in list_pictures(path))]
