"""What a folder holds, as far as the names of its files tell: photos, videos, or a scene and of which layout.

Loads neither NumPy nor torch, so that the command can tell at once what is wrong with a folder.
"""

import os
from functools import cache
from importlib.util import find_spec
from pathlib import Path

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
HEIC_SUFFIXES = (".heic", ".heif", ".hif")
_RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf")
UNREADABLE_SUFFIXES = (*_RAW, *HEIC_SUFFIXES, ".avif", ".gif", ".jxl", ".jp2", ".exr")
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp", ".mpg", ".mpeg", ".mts")
CAMERAS_REPORT = "photos.json"  # beside a scene whose cameras kgs found: how they were found
_NO_POSES = "kgs fit finds them; or run COLMAP (its model goes to sparse/0), or nerfstudio's ns-process-data"
_TO_CONVERT = "photos that cannot be read: convert them to JPEG or PNG"
_NO_PHOTOS = "take photos out (ns-process-data video does that and finds poses)"


@cache
def has_heic() -> bool:
    """Whether HEIC can be read: pi-heif is installed."""
    return find_spec("pi_heif") is not None


def list_images(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> list[Path]:
    """The photos of a folder, sorted by name; hidden files and other kinds of files are passed over."""
    files = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    return sorted(files, key=lambda p: p.name)


def image_folder(root: Path) -> Path | None:
    """The folder of photos beside a model: `images`, else the `images_k` of the largest photos, or None."""
    if (root / "images").is_dir():
        return root / "images"
    reduced = [p for p in root.glob("images_*") if p.is_dir() and p.name.removeprefix("images_").isdecimal()]
    return min(reduced, key=lambda p: int(p.name.removeprefix("images_")), default=None)


def find_model(root: Path) -> Path | None:
    """The folder of a scene that holds a COLMAP model, `sparse/0` or `sparse`; None where there is none."""
    files = (root / f"{folder}/images.{suffix}" for folder in ("sparse/0", "sparse") for suffix in ("bin", "txt"))
    return next((file.parent for file in files if file.is_file()), None)


def layout_of(root: Path) -> str | None:
    """The layout of a scene's folder: LLFF, COLMAP, Blender or nerfstudio; None where it is not a scene."""
    if (root / "poses_bounds.npy").is_file():
        return "LLFF"
    if find_model(root) is not None:
        return "COLMAP"
    if (root / "transforms_train.json").is_file():
        return "Blender"
    return "nerfstudio" if (root / "transforms.json").is_file() else None


def nearest_scene(root: Path) -> Path | None:
    """The folder with camera poses that is meant by a folder: itself, or one up to two levels below or above it.

    One whose cameras kgs found (beside `CAMERAS_REPORT`) is not meant by its photos. None: there is none.
    """
    if layout_of(root):
        return root
    below = sorted(path for pattern in ("*", "*/*") for path in root.glob(pattern) if path.is_dir())
    others = (path for path in (*below, *root.resolve().parents[:2]) if not (path / CAMERAS_REPORT).exists())
    return next(filter(layout_of, others), None)


def why_no_scene(root: Path) -> str:
    """Why a file or folder is not a scene: what it is or holds instead, and what to do."""
    return _about_folder(root) if root.is_dir() else _about_file(root)


def has_photos(scene: Path) -> bool:
    """Whether a scene's folder holds anything that may be its photos; links to folders are not followed, and may."""
    photos = image_folder(scene)
    if photos is not None and any(path.name[0] != "." for path in photos.iterdir()):
        return True
    kinds = (*IMAGE_SUFFIXES, *UNREADABLE_SUFFIXES)
    for folder, folders, files in os.walk(scene):
        if any(file.lower().endswith(kinds) for file in files):
            return True
        if any(os.path.islink(os.path.join(folder, name)) for name in folders):
            return True
    return False


def _about_file(path: Path) -> str:
    if not path.exists():
        return "expected a folder, there is none"
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return f"expected a folder, got a video: {_NO_PHOTOS}"
    return "expected a folder, got a file" + (f": the scene is {path.parent}" if layout_of(path.parent) else "")


def _about_folder(root: Path) -> str:
    if folder := nearest_scene(root):
        return f"is not a scene, but {folder} is one: give that folder"
    photos = image_folder(root) or root
    if count := len(list_images(photos)):
        return f"has {count} photos but no camera poses: {_NO_POSES}"
    endings = [p.suffix.lower() for folder in {root, photos} for p in folder.iterdir() if not p.name.startswith(".")]
    for suffixes, advice in ((UNREADABLE_SUFFIXES, _TO_CONVERT), (VIDEO_SUFFIXES, f"videos: {_NO_PHOTOS}")):
        if found := [ending[1:].upper() for ending in endings if ending in suffixes]:
            return f"is not a scene: it holds {len(found)} {' and '.join(sorted(set(found)))} {advice}"
    return (
        "is not a scene: looked for poses_bounds.npy (LLFF), sparse/0 (COLMAP), transforms_train.json (Blender) and "
        "transforms.json (nerfstudio)"
    )
