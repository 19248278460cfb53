"""Where photos and cameras go: `images`, `masks`, `sparse/0` and `photos.json` in a folder."""

from pathlib import Path
from typing import Any

from kgs._support.errors import DataError
from kgs._support.json_files import read_json
from kgs.app.files.outputs import check_folder
from kgs.datasets.folders import CAMERAS_REPORT, list_images

REPORT = CAMERAS_REPORT
IMAGES = "images"
MASKS = "masks"
MODEL = "sparse/0"


def check_workspace(out: Path, folder: Path) -> None:
    """Raise a DataError if results would lie among the user's photos, or in the folder of another scene."""
    photos = folder.resolve()
    results = [out / IMAGES, out / MASKS, out / "sparse"]
    if photos == out.resolve() or any(photos.is_relative_to(path.resolve()) for path in results):
        raise DataError(out, "", "holds the photos themselves: choose another folder")
    is_of_kgs = (out / REPORT).exists()
    if not is_of_kgs and any(path.is_dir() and list_images(path) for path in results):
        raise DataError(out, "", "holds photos that kgs did not write: choose another folder")
    check_folder(out, folder, make=False)


def is_reusable(out: Path, inputs: dict[str, Any]) -> bool:
    """Whether the report of a former run has the same inputs, and all of its files are there."""
    try:
        report = read_json(out / REPORT)
        images = [out / IMAGES / str(photo["image"]) for photo in report["photos"].values()]
        masks = [out / MASKS / f"{path.name}.png" for path in images] if inputs["masks_sha256"] else []
    except (DataError, KeyError, TypeError, AttributeError):
        return False
    files = [*images, *masks, *(out / MODEL / f"{name}.bin" for name in ("cameras", "images", "points3D"))]
    unchanged = all(report.get(key, {}) == value for key, value in inputs.items())
    return unchanged and all(path.is_file() for path in files)
