"""Finds the photos in a user's folder; errors say what it holds instead, and what to do about it."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kgs._support.errors import DataError, listed, quantity
from kgs.app.files.results import MARKER
from kgs.datasets import folders
from kgs.datasets.folders import (
    HEIC_SUFFIXES,
    IMAGE_SUFFIXES,
    MASKS_ARE_IN,
    PICTURE_SUFFIXES,
    UNREADABLE_SUFFIXES,
    VIDEO_SUFFIXES,
    holds_picture,
    is_like_mask,
    list_images,
    list_pictures,
)

if TYPE_CHECKING:
    from kgs.datasets.masks import MaskFiles

MIN_PHOTOS = 3
MAX_FRAMES = 36  # of a video, where twelve would be too far apart
CONVERT = (
    'kgs reads PNG, JPEG, WebP, TIFF and BMP, and HEIC with its extra: pip install ".[heic]"\n'
    "Or make JPEGs: `sips -s format jpeg *.HEIC --out jpeg` on a Mac, else `magick mogrify -format jpg *.HEIC`\n"
    "An iPhone takes JPEGs from the start: Settings > Camera > Formats > Most Compatible"
)
ADVICE = "Take 3 to 12 photos of one scene that does not move, a small step between them, so that neighbours overlap"


def find_photos(folder: Path) -> list[Path]:
    """The photos of a folder, sorted by name.

    Of a photo that is there as a JPEG and as a raw or HEIC file of the same stem, the JPEG is taken.

    Raises:
        DataError: the folder does not exist, it holds fewer than 3 photos, or photos of a kind that cannot be read.
    """
    if not folder.is_dir():
        raise DataError(folder, "", "a folder of photos", "no such folder")
    pictures, converted = _pictures(folder)
    paths = [path for path in pictures if path.suffix.lower() in _readable() and path.is_file()]
    if lost := [path for path in pictures if not path.exists()]:
        raise DataError(folder, "", "photos", "links to files that are not there", advice=listed_files(lost))
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and not path.name.startswith(".")]
    videos = [path for path in files if _is_video(path)]
    unreadable = set(UNREADABLE_SUFFIXES).difference(_readable())
    if others := [path for path in files if path.suffix.lower() in unreadable and path not in converted]:
        got = f"{len(others)} of {len(others) + len(paths)} of another kind ({listed_files(others)})"
        raise DataError(folder, "", "photos that can be read", got, advice=CONVERT)
    if not paths and videos:
        raise DataError(folder, "", "photos or a video", f"videos ({listed_files(videos)})", advice="name one of them")
    if not paths:
        deeper = [path for path in sorted(folder.iterdir()) if path.is_dir() and _holds_photos(path)]
        inner = f"these folders in it hold some: {listed_files(deeper)}. Name one of them"
        advice = ". ".join([inner if deeper else ADVICE, *folders.unused_files(folder), *_nameless(folder)])
        raise DataError(folder, "", f"photos ({' '.join(_readable())})", "none", advice=advice)
    if len(paths) < MIN_PHOTOS:
        advice = ". ".join([ADVICE, *_nameless(folder)])
        got = f"{len(paths)} ({listed_files(paths)})"
        raise DataError(folder, "", f"at least {MIN_PHOTOS} photos", got, advice=advice)
    return paths


def find_video(path: Path) -> Path | None:
    """The video that is meant by a path: this file, or the only one in a folder without photos; None: there is none."""
    if path.is_file():
        return path if _is_video(path) else None
    if not path.is_dir() or list_images(path, PICTURE_SUFFIXES):
        return None
    videos = [file for file in sorted(path.iterdir()) if file.is_file() and _is_video(file)]
    return videos[0] if len(videos) == 1 else None


def _is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".")


def notes_on(folder: Path, photos: Sequence[Path], masks: "MaskFiles") -> list[str]:
    """What a folder of photos holds that is not used, a sentence each."""
    notes = [*folders.unused_files(folder), *_nameless(folder), *masks.notes(folder)]
    used = [path.resolve() for path in (*masks.masks.values(), *masks.unused)]
    inner = [path for path in sorted(folder.iterdir()) if path.is_dir()]
    inner = [path for path in inner if not any(file.is_relative_to(path.resolve()) for file in used)]
    called = {path for path in inner if path.suffix.lower() in PICTURE_SUFFIXES}
    if deeper := [path for path in inner if path in called or (_holds_photos(path) and not (path / MARKER).exists())]:
        notes.append(f"not looked into, because they are folders: {listed_files(deeper)}")
    if like_masks := [path for path in photos if is_like_mask(path)]:
        notes.append(f"named like masks and taken for photos: {listed_files(like_masks)}: {MASKS_ARE_IN}")
    if converted := sorted(_pictures(folder)[1]):
        files = quantity(len(converted), "raw or HEIC file")
        notes.append(f"{files} not used, the JPEG of the same name is: {listed_files(converted)}")
    return notes


def _nameless(folder: Path) -> list[str]:
    """A sentence about files that are pictures, and not taken, because they are hidden or without a known ending."""
    known = {*list_pictures(folder, PICTURE_SUFFIXES)}
    files = [path for path in sorted(folder.iterdir()) if path not in known]
    pictures = [path for path in files if path.is_file() and holds_picture(path)]
    said = "pictures that are not used, hidden or without a known ending"
    return [f"{said}: {listed_files(pictures)}"] if pictures else []


def _pictures(folder: Path) -> tuple[list[Path], set[Path]]:
    """The pictures of a folder; and the raw and HEIC files that are also there, by the same stem, as a JPEG or PNG."""
    pictures = list_images(folder, PICTURE_SUFFIXES)
    stems = {path.stem.lower() for path in pictures if path.suffix.lower() in IMAGE_SUFFIXES}
    of_others = [path for path in pictures if path.suffix.lower() in UNREADABLE_SUFFIXES]
    converted = {path for path in of_others if path.stem.lower() in stems}
    return [path for path in pictures if path not in converted], converted


def _readable() -> tuple[str, ...]:
    return IMAGE_SUFFIXES + (HEIC_SUFFIXES if folders.has_heic() else ())


def listed_files(paths: list[Path]) -> str:
    """The names of files, the first of them."""
    return listed([path.name for path in paths])


def _holds_photos(folder: Path) -> bool:
    try:
        return any(path.suffix.lower() in PICTURE_SUFFIXES for path in folder.iterdir())
    except OSError:
        return False
