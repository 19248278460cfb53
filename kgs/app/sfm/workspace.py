"""Where photos and cameras go: `images`, `masks`, `sparse/0` and `photos.json` in a folder."""

from pathlib import Path
from typing import Any

from kgs._support.errors import DataError
from kgs._support.json_files import read_json
from kgs.app.files.outputs import check_folder, png_names
from kgs.app.files.publishing import UNFINISHED, check_free, is_own, read_marker
from kgs.datasets.folders import CAMERAS_REPORT, list_images

REPORT = CAMERAS_REPORT
IMAGES = "images"
MASKS = "masks"
MODEL = "sparse/0"


def check_workspace(out: Path, paths: list[Path]) -> None:
    """Raise a DataError if results would lie among these photos or others of the user, or in a folder of a scene."""
    folder = paths[0].parent
    photos = folder.resolve()
    results = [out / IMAGES, out / MASKS, out / "sparse"]
    if photos == out.resolve() or any(photos.is_relative_to(path.resolve()) for path in results):
        raise DataError(out, "", "another folder than that of the photos")
    check_folder(out, folder, make=False)
    images = [f"{IMAGES}/{name}" for name in png_names(path.name for path in paths).values()]
    masks = [f"{MASKS}/{Path(name).name}.png" for name in images]
    model = [f"{MODEL}/{name}.bin" for name in ("cameras", "images", "points3D")]
    there = [f"{path.name}/{photo.name}" for path in results if path.is_dir() for photo in list_images(path)]
    check_free(out, "photos", [REPORT, *images, *masks, *model, *there])
    check_free(out / UNFINISHED, "photos", [REPORT, *images, *masks, *model])


def is_reusable(out: Path, inputs: dict[str, Any]) -> bool:
    """Whether the report of a former run has the same inputs, and its files are as they were written."""
    try:
        report = read_json(out / REPORT)
    except DataError:
        return False
    files = read_marker(out).get("photos", {})
    return REPORT in files and is_own(out, *files) and all(report.get(key, {}) == inputs[key] for key in inputs)
