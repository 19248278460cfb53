"""Which files are the masks of photos, judged by their names and places; loads neither NumPy nor torch.

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
        raise DataError(folder, "", "expected a folder of masks, found no such folder")
    parents = [place for place in sorted({photo.parent for photo in photos}) if place.is_dir()]
    on_disk = _by_name(photo for place in parents for photo in list_images(place))
    places = _places(root, parents)
    searched = {place: photos for place in [folder] if place is not None} or {
        inner: [photo for photo in photos if place == root or photo.is_relative_to(place)]
        for place in places
        for inner in mask_folders([place])
        if inner not in parents
    }
    keeping = dict[Path, Path]()
    unused = list[Path]()
    is_strict = True
    for place, own in searched.items():
        masks, others = _pictures(place, own)
        if folder is not None and not masks:
            raise DataError(folder, "", "expected masks, pictures with the stems of the photos, found none")
        found, unfit = _of_folder(place, masks, own, on_disk, is_strict)
        is_strict = is_strict and not masks
        unused += [*others, *unfit, *(mask for photo, mask in found.items() if photo in keeping)]
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
        unused += _like_mask_folders(places, {photo for photo in photos if photo not in keeping | moving})
    return MaskFiles(keeping, moving, unused)


def _places(root: Path, parents: Sequence[Path]) -> list[Path]:
    """The scene's folder, those of its photos, and those between."""
    between = [place for parent in parents if parent.is_relative_to(root) for place in parent.parents]
    inside = sorted({place for place in [*parents, *between] if place.is_relative_to(root)})
    return [*dict.fromkeys([root, *inside, *parents])]


def _pictures(folder: Path, photos: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """The masks in a folder and in folders in it that have the names of the photos' folders; and what else may be."""
    parents = {_lower(photo.parent) for photo in photos}
    masks = list[Path]()
    others = list[Path]()
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        inner = _lower(Path(place).relative_to(folder))
        is_read = any(_ends(parent, inner) for parent in parents)
        for name in sorted(files):
            path = Path(place, name)
            if path.suffix.lower() in _SUFFIXES and not name.startswith("."):
                (masks if is_read and path.suffix.lower() in IMAGE_SUFFIXES else others).append(path)
    return masks, others


def _of_folder(
    folder: Path, masks: Sequence[Path], photos: Sequence[Path], on_disk: dict[str, list[Path]], is_strict: bool
) -> tuple[dict[Path, Path], list[Path]]:
    """The masks of a folder by their photos, and those that fit none of the files on disk, several, or one twice."""
    by_name = _by_name(photos)
    found = dict[Path, Path]()
    unfit = list[Path]()
    for mask in masks:
        fitting = _fitting(mask, by_name, folder)
        reason = ""
        if len(fitting) > 1:
            reason = f"expected a mask of one photo, it fits {fitting[0]} and {fitting[1]}"
        elif not fitting and not _fitting(mask, on_disk, folder):
            reason = "fits no photo: expected the stem of one, as IMG_1.png for IMG_1.jpg"
        elif fitting and fitting[0] in found:
            reason = f"expected one mask of {fitting[0].name}, got {found[fitting[0]].name} too"
        elif fitting:
            found[fitting[0]] = mask
        if reason and is_strict:
            raise DataError(mask, "", reason)
        if reason:
            unfit.append(mask)
    return found, unfit


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
    for place in parents:
        for mask, photo in masks_beside(place).items():
            if photo not in known or mask in known:
                continue
            if photo in found:
                raise DataError(mask, "", f"expected one mask of {photo.name}, got {found[photo].name} too")
            found[photo] = mask
    return found


def _like_masks_beside(photos: Sequence[Path], parents: Sequence[Path], on_disk: dict[str, list[Path]]) -> list[Path]:
    """Pictures among the photos, but none of them, that are named like masks of no photo there."""
    known = set(photos)
    like = [path for place in parents for path in list_images(place) if is_like_mask(path) and path not in known]
    dynamic = [path for place in parents for path in sorted(place.glob(f"{MASK_FILES}*"))]
    return like + [
        path
        for path in dynamic
        if path.suffix.lower() in _SUFFIXES
        and (path.suffix != ".png" or path.stem.removeprefix(MASK_FILES).lower() not in on_disk)
    ]


def _like_mask_folders(places: Sequence[Path], photos: set[Path]) -> list[Path]:
    """Folders that are named like masks, but not as `mask_folders`, and hold pictures named as one of these photos."""
    stems = {photo.stem.lower() for photo in photos}
    folders = [path for place in filter(Path.is_dir, places) for path in sorted(place.iterdir()) if path.is_dir()]
    known = {*places, *mask_folders(places)}
    like = [path for path in folders if is_like_mask(path) and path not in known]
    return [path for path in like if any(photo_of_mask(picture)[0] in stems for picture in list_pictures(path))]
