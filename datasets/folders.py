"""What a folder holds, judged by the names of its files: photos, or a scene and its layout.

Loads neither NumPy nor torch, so that the command reports a wrong folder at once.
"""

import os
import re
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from kgs._support.errors import DataError, listed, quantity


class Layout(NamedTuple):
    """How the files of a scene lie in its folder."""

    file: str = ""  # says where the cameras are; "": a COLMAP model does
    has_sizes: bool = False  # the same photos may be there in several sizes, a folder for each


# In the order in which they are looked for. The function `load` in layouts/x.py reads layout X.
LAYOUTS = {
    "LLFF": Layout("poses_bounds.npy", has_sizes=True),
    "COLMAP": Layout(has_sizes=True),
    "Blender": Layout("transforms_train.json"),
    "nerfstudio": Layout("transforms.json"),
}
POSE_FILES = tuple(layout.file for layout in LAYOUTS.values() if layout.file)

_JPEG = (".jpg", ".jpeg", ".jpe", ".jfif", ".jif", ".pjpeg", ".pjp")
IMAGE_SUFFIXES = (".png", *_JPEG, ".webp", ".bmp", ".dib", ".tif", ".tiff")
HEIC_SUFFIXES = (".heic", ".heif", ".hif")
_RAW = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".srf", ".raf", ".rw2", ".rwl", ".orf"),
    *(".pef", ".srw", ".x3f", ".3fr", ".fff", ".iiq", ".gpr", ".erf", ".kdc", ".dcr", ".mrw", ".mef", ".mos"),
)
_OTHERS = (
    *(".avif", ".gif", ".jxl", ".jxr", ".jp2", ".j2k", ".jpf", ".jpx", ".mpo"),
    *(".exr", ".hdr", ".psd", ".tga", ".ppm", ".pgm", ".pnm"),
)
UNREADABLE_SUFFIXES = (*_RAW, *HEIC_SUFFIXES, *_OTHERS)
PICTURE_SUFFIXES = (*IMAGE_SUFFIXES, *UNREADABLE_SUFFIXES)
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp", ".mpg", ".mpeg", ".mts")
CAMERAS_REPORT = "photos.json"  # beside a scene whose cameras kgs found: how they were found
_MAY_HOLD_CAMERAS = (".json", ".xml", ".xmp", ".csv", ".nvm", ".out", ".sfm", ".npy", ".npz", ".traj", ".r3d")
MASKS = "masks"  # the folder of masks
MASKS_ARE_IN = f"masks are in {MASKS}/ or the folder that --masks names, as IMG_1.png or IMG_1.jpg.png for IMG_1.jpg"
_MASK_OF = re.compile(r"(?:dynamic_)?mask[ _.-](.+)|(.+)[ _.-]mask")
_LIKE_MASK = re.compile(r"mask|matte|segment|(?<![a-z])(seg|alpha)(?![a-z])")
# How files begin that are pictures whatever their name is; of WebP and the family of HEIC see `holds_picture`.
_SIGNATURES = (b"\x89PNG\r\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"GIF8")
_FAMILIES = (b"hei", b"hev", b"mif", b"msf", b"avi", b"crx")  # brands, of HEIC, AVIF and Canon's raw


@cache
def has_heic() -> bool:
    """Whether HEIC can be read: pi-heif is installed."""
    return find_spec("pi_heif") is not None


def list_images(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> list[Path]:
    """The photos of a folder, sorted by name; what is named like a mask of a picture there is passed over."""
    pictures = list_pictures(folder, PICTURE_SUFFIXES)
    names = {name.lower() for path in pictures for name in (path.name, path.stem)}
    return [path for path in pictures if path.name.lower().endswith(suffixes) and _photo_of(path) not in names]


def list_pictures(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> list[Path]:
    """The pictures of a folder, masks among them, sorted by name; hidden files are passed over."""
    with os.scandir(folder) as entries:  # which know without a look at the disk whether they are folders
        files = [entry for entry in entries if entry.name.lower().endswith(suffixes) and not entry.is_dir()]
    return [folder / name for name in sorted(file.name for file in files) if not name.startswith(".")]


def _photo_of(path: Path) -> str | None:
    """The name or stem of the photo whose mask a picture says to be, as IMG_1_mask.png and IMG_1.jpg.png; or None."""
    stem = path.stem.lower()
    if match := _MASK_OF.fullmatch(stem):
        return match[1] or match[2]
    return stem if path.suffix.lower() == ".png" and stem.endswith(PICTURE_SUFFIXES) else None


def is_like_mask(path: Path) -> bool:
    """Whether a folder or picture that is not used as a mask is named like one."""
    return _LIKE_MASK.search(path.stem.lower()) is not None


def holds_picture(path: Path) -> bool:
    """Whether a file is a picture by how it begins, whatever its name is."""
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError:
        return False
    is_of_family = head[4:8] == b"ftyp" and head[8:11] in _FAMILIES
    return head.startswith(_SIGNATURES) or head[8:] == b"WEBP" or is_of_family


def image_folder(root: Path, name: str = "") -> Path | None:
    """The folder of photos beside a model: `images`, else the `images_k` of the largest photos, or None.

    With a name the folder of that name; a DataError where there is none.
    """
    if name and not (root / name).is_dir():
        raise DataError(root, "", f"the photos in {name}/", "no such folder")
    if name or (root / "images").is_dir():
        return root / (name or "images")
    reduced = [p for p in root.glob("images_*") if p.is_dir() and p.name.removeprefix("images_").isdecimal()]
    return min(reduced, key=lambda p: int(p.name.removeprefix("images_")), default=None)


def find_models(root: Path) -> list[Path]:
    """The folders of a scene that hold a COLMAP model: `sparse/0`, `sparse/1` and so on, `sparse`, the scene itself.

    The scene's own folder counts where photos are in it or in `images`.
    """
    numbered = [p for p in (root / "sparse").glob("*") if p.name.isdecimal()]
    numbered.sort(key=lambda p: int(p.name))
    models = [folder for folder in (*numbered, root / "sparse") if _has_model_file(folder, "images")]
    is_beside_photos = _is_model(root) and (image_folder(root) is not None or bool(list_images(root)))
    return models + ([root] if is_beside_photos else [])


def layout_of(root: Path) -> str | None:
    """The layout of a scene's folder: LLFF, COLMAP, Blender or nerfstudio; None where it is not a scene."""
    models = find_models(root)
    is_in_sparse = models[:1] not in ([], [root])  # a model beside the photos comes after all other layouts
    for name, layout in LAYOUTS.items():
        if (root / layout.file).is_file() if layout.file else is_in_sparse:
            return name
    return "COLMAP" if models else None


def _has_model_file(folder: Path, stem: str) -> bool:
    return any((folder / f"{stem}.{suffix}").is_file() for suffix in ("bin", "txt"))


def _is_model(folder: Path) -> bool:
    return _has_model_file(folder, "images") and _has_model_file(folder, "cameras")


def unused_files(root: Path, layout: str | None = None) -> tuple[str, ...]:
    """What a folder holds besides the files of its layout that says, or may say, where cameras are: a sentence each."""
    if layout is not None:
        others = [name for name in POSE_FILES if name != LAYOUTS[layout].file and (root / name).is_file()]
        others += ["the COLMAP model"] if _is_model(root) and layout in ("Blender", "nerfstudio") else []
        return tuple(f"{name} is not used: the scene is read as {layout}" for name in others)
    sentences = []
    if _is_model(root):
        sentences.append("the COLMAP model is not used: expected its photos beside it or in images/")
    files = [path for path in sorted(root.iterdir()) if path.suffix.lower() in _MAY_HOLD_CAMERAS]
    if names := [path.name for path in files if path.name[0] != "." and path.is_file()]:
        read = f"kgs reads {', '.join(POSE_FILES)} and COLMAP models: export one of these"
        sentences.append(f"not read, though they may hold cameras: {listed(names)} ({read})")
    return tuple(sentences)


def scene_nearby(root: Path) -> Path | None:
    """The folder with camera poses that is meant by a folder without: one up to two levels below or above it.

    One whose cameras kgs found (beside `CAMERAS_REPORT`) is not meant by its photos. None: there is none.
    """
    below = sorted(path for pattern in ("*", "*/*") for path in root.glob(pattern) if path.is_dir())
    others = (path for path in (*below, *root.resolve().parents[:2]) if not (path / CAMERAS_REPORT).exists())
    return next(filter(layout_of, others), None)


def no_scene(root: Path) -> DataError:
    """The error about a file or folder that is not a scene, which says what to do."""
    if not root.exists():
        return DataError(root, "", "a folder", "none")
    got = "another folder" if root.is_dir() else "a file"
    if folder := scene_nearby(root):
        return DataError(root, "", "a scene", got, advice=f"{folder} is one: give that folder")
    if not root.is_dir():
        meant = f"for photos, name their folder: {root.parent}" if root.suffix.lower() in PICTURE_SUFFIXES else ""
        return DataError(root, "", "a folder", "a file", advice=meant)
    advice = f"there is no {', '.join(POSE_FILES)} or COLMAP model in sparse/0"
    if count := len(list_images(image_folder(root) or root, PICTURE_SUFFIXES)):
        got = f"{quantity(count, 'photo')} without camera poses"
        advice = "kgs fit finds them, or COLMAP (its model goes to sparse/0)"
    return DataError(root, "", "a scene", got, advice=". ".join([advice, *unused_files(root)]))


def has_photos(scene: Path) -> bool:
    """Whether a scene's folder holds anything that may be its photos; links to folders are not followed, and may."""
    photos = image_folder(scene)
    if photos is not None and any(path.name[0] != "." for path in photos.iterdir()):
        return True
    for folder, folders, files in os.walk(scene):
        links = [name for name in folders if os.path.islink(os.path.join(folder, name))]
        if links or any(file.lower().endswith(PICTURE_SUFFIXES) for file in files):
            return True
    return False
