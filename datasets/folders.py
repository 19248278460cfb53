"""What a folder holds, judged by the names of its files: photos, videos, or a scene and its layout.

Loads neither NumPy nor torch, so that the command reports a wrong folder at once.
"""

import os
import re
import warnings
from collections.abc import Iterable
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from kgs._support.errors import DataError, quantity

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
# How files begin that are pictures whatever their name is; of BMP and of the family of HEIC see `holds_picture`.
_SIGNATURES = (
    *(b"\x89PNG\r\n", b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"GIF8"),
    *(b"\xff\x0a", b"\0\0\0\x0cJXL ", b"\0\0\0\x0cjP  "),
)
_FAMILIES = (b"hei", b"hev", b"mif", b"msf", b"avi", b"crx")  # brands, of HEIC, AVIF and Canon's raw
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp", ".mpg", ".mpeg", ".mts")
# What says where the cameras of a scene are, in the order in which it is looked for; a COLMAP model comes second.
LAYOUT_FILES = {"LLFF": "poses_bounds.npy", "Blender": "transforms_train.json", "nerfstudio": "transforms.json"}
_AS_MODEL = "export the cameras of {} as a COLMAP model to use them"
_CONVERTED = "it is of {}: nerfstudio's ns-process-data {} makes a scene of the export; kgs fit takes {} alone"
_ALONE = "it has the poses of {}, which are not read: kgs fit takes {} alone"
_RECORDING = "it is a recording of Record3D: export it as EXR and JPG, for nerfstudio's ns-process-data record3d"
# Of programs and data sets whose poses are not read: the files that show it, all of them, and what to do.
_NOT_READ = {
    ("reconstruction.json",): _AS_MODEL.format("OpenSfM"),
    ("cameras.sfm",): _AS_MODEL.format("Meshroom"),
    ("sfm_data.json",): _AS_MODEL.format("OpenMVG"),
    ("cameras.xml",): _AS_MODEL.format("Metashape"),
    ("bundle.out",): _AS_MODEL.format("Bundler"),
    ("*.nvm",): _AS_MODEL.format("VisualSFM"),
    ("keyframes/*cameras/*.json",): _CONVERTED.format("Polycam", "polycam", "keyframes/images"),
    ("*cameras/*.json", "images"): _CONVERTED.format("Polycam", "polycam", "images"),
    ("metadata.json", "*.exr"): _CONVERTED.format("Record3D", "record3d", "rgb"),
    ("metadata.json", "*/*.exr"): _CONVERTED.format("Record3D", "record3d", "rgb"),
    ("EXR_RGBD/metadata.json",): _CONVERTED.format("Record3D", "record3d", "EXR_RGBD/rgb"),
    ("*.r3d",): _RECORDING,
    ("rgbd/*.depth",): _RECORDING,  # unpacked
    ("opensfm/reconstruction.json",): _CONVERTED.format("OpenDroneMap", "odm", "images"),
    ("odometry.csv", "camera_matrix.csv"): _ALONE.format("Stray Scanner", "rgb.mp4"),
    ("info.json", "frame_*.json"): _ALONE.format("3D Scanner App", "its photos"),
    ("lowres_wide.traj",): _ALONE.format("ARKitScenes", "lowres_wide"),
    ("pose/*.txt", "intrinsic/*.txt"): _ALONE.format("ScanNet", "color"),
    ("pose/*.txt", "intrinsics.txt"): _ALONE.format("NSVF", "rgb"),
    ("cameras_sphere.npz",): _ALONE.format("NeuS", "image"),
    ("cams/*_cam.txt",): _ALONE.format("MVSNet", "images"),
}
_MISSPELLED = {
    "transform.json": "transforms.json",
    "transform_train.json": "transforms_train.json",
    "transform_test.json": "transforms_test.json",
}
MASK_FOLDERS = ("masks", "mask")
MASK_FILES = "dynamic_mask_"  # instant-ngp's, beside the photos
_MASK_NAME = re.compile(r"mask[ _.-](.+)|(.+)[ _.-]mask")
# Names that only look like those of masks.
_LIKE_MASKS = re.compile(r"mask|matte|segment|(?<![a-z])(seg|alpha)(?![a-z])")
_SAME = 8  # levels between the channels of a grey picture that was compressed with loss
MASKS_ARE_IN = "masks are in masks/ or the folder that --masks names, or beside their photos as IMG_1_mask.png"
CAMERAS_REPORT = "photos.json"  # beside a scene whose cameras kgs found: how they were found
_NO_POSES = "kgs fit finds them; or run COLMAP (its model goes to sparse/0), or nerfstudio's ns-process-data"
_NO_PHOTOS = "take photos out (ns-process-data video does that and finds poses)"


@cache
def has_heic() -> bool:
    """Whether HEIC can be read: pi-heif is installed."""
    return find_spec("pi_heif") is not None


def list_images(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> list[Path]:
    """The photos of a folder, sorted by name; hidden files, masks and other kinds of files are passed over."""
    masks = {*masks_beside(folder)}
    return [path for path in list_pictures(folder, suffixes) if path not in masks]


def list_pictures(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> list[Path]:
    """As `list_images`, with masks, but for those of instant-ngp."""
    with os.scandir(folder) as entries:  # which know without a look at the disk whether they are folders
        files = [entry for entry in entries if entry.name.lower().endswith(suffixes) and not entry.is_dir()]
    return [folder / name for name in sorted(file.name for file in files) if not name.startswith((".", MASK_FILES))]


def masks_beside(folder: Path) -> dict[Path, Path]:
    """The photos in a folder by their masks in it: grey pictures whose names contain those of the photos.

    The names are those of `photo_of_mask`; one that does not say that it is a mask ends in `.png`, as COLMAP writes it.
    """
    pictures = list_pictures(folder, UNREADABLE_SUFFIXES) + list_pictures(folder)
    of_name = {path.name.lower(): path for path in pictures}
    of_stem = {path.stem.lower(): path for path in pictures}
    masks = dict[Path, Path]()
    for path in pictures:
        name, is_marked = photo_of_mask(path)
        photo = of_name.get(name) or (of_stem.get(name) if is_marked else None)
        suffixes = IMAGE_SUFFIXES if is_marked else (".png",)
        if photo is not None and path.suffix.lower() in suffixes and _is_grey(path):
            masks[path] = photo
    return masks


def _is_grey(path: Path) -> bool:
    """Whether a file is a picture without colours, as masks are."""
    try:
        status = path.stat()
        return _is_grey_now(path, status.st_mtime_ns, status.st_size)
    except OSError:
        return False


@cache
def _is_grey_now(path: Path, time: int, size: int) -> bool:
    """`_is_grey` of a file that was changed at this time."""
    from PIL import Image, ImageChops

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:  # of many pixels, damaged metadata
            if image.mode in ("1", "L", "LA") or image.mode.startswith("I"):
                return True
            red, *others = image.convert("RGB").split()
        return not any(any(ImageChops.difference(red, other).histogram()[_SAME + 1 :]) for other in others)
    except Exception:  # damaged bytes raise whatever Pillow's plugins happen to raise
        return False


def photo_of_mask(mask: Path) -> tuple[str, bool]:
    """The name or stem of the photo, in lower case, that a file is a mask of if it is one; whether its name says so.

    It is "img_1" of `IMG_1_mask.png`, `mask_IMG_1.png` and `IMG_1.png`, and "img_1.jpg" of `IMG_1.jpg.png`. The first
    two say that they are masks.
    """
    stem = mask.stem.lower()
    match = _MASK_NAME.fullmatch(stem)
    return (match[1] or match[2], True) if match else (stem, False)


def mask_folders(outer_folders: Iterable[Path]) -> list[Path]:
    """The folders of masks in other folders: `masks` first, then `mask`, in upper or lower case."""
    found = []
    for outer in filter(Path.is_dir, outer_folders):
        inner = [path for path in sorted(outer.iterdir()) if path.name.lower() in MASK_FOLDERS and path.is_dir()]
        found += sorted(inner, key=lambda path: MASK_FOLDERS.index(path.name.lower()))
    return found


def is_like_mask(path: Path) -> bool:
    """Whether a folder or picture that is not taken for masks is named like one."""
    return _LIKE_MASKS.search(path.stem.lower()) is not None


def holds_picture(path: Path) -> bool:
    """Whether a file is a picture by how it begins, whatever its name is."""
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError:
        return False
    is_webp = head[:4] == b"RIFF" and head[8:12] == b"WEBP"
    is_bmp = head[:2] == b"BM" and head[6:10] == bytes(4)
    return is_webp or is_bmp or head.startswith(_SIGNATURES) or (head[4:8] == b"ftyp" and head[8:11] in _FAMILIES)


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
    return models + ([root] if _is_model_beside_photos(root) else [])


def layout_of(root: Path) -> str | None:
    """The layout of a scene's folder: LLFF, COLMAP, Blender or nerfstudio; None where it is not a scene."""
    models = find_models(root)
    if (root / LAYOUT_FILES["LLFF"]).is_file():
        return "LLFF"
    if models and models != [root]:
        return "COLMAP"
    for layout in ("Blender", "nerfstudio"):
        if (root / LAYOUT_FILES[layout]).is_file():
            return layout
    return "COLMAP" if models else None


def _has_model_file(folder: Path, stem: str) -> bool:
    return any((folder / f"{stem}.{suffix}").is_file() for suffix in ("bin", "txt"))


def _is_model(folder: Path) -> bool:
    return _has_model_file(folder, "images") and _has_model_file(folder, "cameras")


def _is_model_beside_photos(root: Path) -> bool:
    return _is_model(root) and (image_folder(root) is not None or bool(list_images(root)))


def unused_files(root: Path, layout: str | None = None) -> tuple[str, ...]:
    """What a folder holds besides the files of its layout, or of any, that looks like cameras: one sentence each."""
    sentences = []
    for other, name in LAYOUT_FILES.items():
        if other != layout and (root / name).is_file():
            sentences.append(f"{name} is not used: the scene is read as {layout}")
    if _is_model(root) and layout is None:
        sentences.append("the COLMAP model is not used: expected its photos beside it or in images/")
    if _is_model(root) and layout in ("Blender", "nerfstudio"):
        sentences.append(f"the COLMAP model is not used: the scene is read as {layout}")
    for patterns, advice in _NOT_READ.items():
        if all(any(root.glob(pattern)) for pattern in patterns):
            sentences.append(f"{' with '.join(patterns)} is not used: {advice}")
    for name, right in _MISSPELLED.items():
        if (root / name).is_file():
            sentences.append(f"{name} is not used: expected the name {right}")
    return tuple(sentences)


def scene_nearby(root: Path) -> Path | None:
    """The folder with camera poses that is meant by a folder without: one up to two levels below or above it.

    One whose cameras kgs found (beside `CAMERAS_REPORT`) is not meant by its photos. None: there is none.
    """
    below = sorted(path for pattern in ("*", "*/*") for path in root.glob(pattern) if path.is_dir())
    others = (path for path in (*below, *root.resolve().parents[:2]) if not (path / CAMERAS_REPORT).exists())
    return next(filter(layout_of, others), None)


def no_scene(root: Path) -> DataError:
    """The error about a file or folder that is not a scene: what it is or holds instead, and what to do."""
    if not root.is_dir():
        got, advice = _about_file(root)
        return DataError(root, "", "a folder", got, advice=advice)
    got, advice = _about_folder(root)
    return DataError(root, "", "a scene", got, advice=". ".join(filter(None, [advice, *unused_files(root)])))


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


def _about_file(path: Path) -> tuple[str, str]:
    if not path.exists():
        return "none", ""
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return "a video", _NO_PHOTOS
    if layout_of(path.parent):
        return "a file", f"the scene is {path.parent}"
    advice = [advice for patterns, advice in _NOT_READ.items() if len(patterns) == 1 and path.match(patterns[0])]
    if path.suffix.lower() == ".zip":
        advice = ["it is an archive: unpack it first"]
    if path.suffix.lower() in (*IMAGE_SUFFIXES, *HEIC_SUFFIXES):
        advice = [f"for photos, name their folder: {path.parent}"]
    return "a file", next(iter(advice), "")


def _about_folder(root: Path) -> tuple[str, str]:
    if folder := scene_nearby(root):
        return "another folder", f"{folder} is one: give that folder"
    photos = image_folder(root) or root
    if count := len(list_images(photos)):
        return f"{quantity(count, 'photo')} without camera poses", _NO_POSES
    endings = [p.suffix.lower() for folder in {root, photos} for p in folder.iterdir() if not p.name.startswith(".")]
    others = (
        (UNREADABLE_SUFFIXES, "photos that cannot be read", "convert them to JPEG or PNG"),
        (VIDEO_SUFFIXES, "videos", _NO_PHOTOS),
    )
    for suffixes, what, advice in others:
        if kinds := [ending[1:].upper() for ending in endings if ending in suffixes]:
            return f"{len(kinds)} {' and '.join(sorted(set(kinds)))} {what}", advice
    return "another folder", (
        "there is no poses_bounds.npy (LLFF), sparse/0 (COLMAP), transforms_train.json (Blender) or transforms.json "
        "(nerfstudio)"
    )
