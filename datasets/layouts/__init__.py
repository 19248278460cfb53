"""The file layouts that `load_scene` reads, one file each: from a folder to a `FrameSet`."""

from pathlib import Path

from kgs.datasets.frames import FrameSet
from kgs.datasets.images import UNREADABLE_SUFFIXES, VIDEO_SUFFIXES, image_folder, list_images
from kgs.errors import DataError

from .blender import load_blender
from .colmap import load_colmap
from .colmap_model import find_model
from .llff import load_llff
from .nerfstudio import load_nerfstudio

_LAYOUTS = (
    (lambda root: (root / "poses_bounds.npy").is_file(), load_llff),
    (lambda root: find_model(root) is not None, load_colmap),
    (lambda root: (root / "transforms_train.json").is_file(), load_blender),
    (lambda root: (root / "transforms.json").is_file(), load_nerfstudio),
)
CAMERAS_REPORT = "photos.json"  # beside a scene whose cameras kgs found: how they were found
_NO_POSES = "kgs fit finds them; or run COLMAP (its model goes to sparse/0), or nerfstudio's ns-process-data"
_TO_CONVERT = "photos that cannot be read: convert them to JPEG or PNG"
_NO_PHOTOS = "take photos out (ns-process-data video does that and finds poses)"


def find_layout(root: Path) -> FrameSet:
    """What the files of a scene's folder say. If it is no scene, a DataError says what it is, and what to do."""
    if not root.is_dir():
        raise DataError(root, "", _about_file(root))
    for is_there, load in _LAYOUTS:
        if is_there(root):
            return load(root)
    raise DataError(root, "", _about_folder(root))


def _is_scene(folder: Path) -> bool:
    return any(is_there(folder) for is_there, _ in _LAYOUTS)


def nearest_scene(root: Path) -> Path | None:
    """The scene that a user means by a folder: itself, or else one up to two levels below or above it; None if none is.

    A scene whose cameras kgs found (it has a `CAMERAS_REPORT`) is meant only by itself, not by a folder of photos.
    """
    if _is_scene(root):
        return root
    below = sorted(path for pattern in ("*", "*/*") for path in root.glob(pattern) if path.is_dir())
    others = (path for path in (*below, *root.resolve().parents[:2]) if not (path / CAMERAS_REPORT).exists())
    return next(filter(_is_scene, others), None)


def _about_file(path: Path) -> str:
    if not path.exists():
        return "expected a folder, there is none"
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return f"expected a folder, got a video: {_NO_PHOTOS}"
    return "expected a folder, got a file" + (f": the scene is {path.parent}" if _is_scene(path.parent) else "")


def _about_folder(root: Path) -> str:
    """Why a folder is not a scene: what it holds instead, and what to do."""
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
