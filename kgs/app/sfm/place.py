"""Where photos and cameras go: `images`, `masks`, `sparse/0` and `photos.json` in a folder, all or none.

New ones go through `unfinished-photos` and `finished-photos`, see `Staging`. Beside a fit, which belongs to the former
cameras, they wait in the second folder until the new fit is there.
"""

import os
from pathlib import Path
from typing import Any

from kgs.app.files.ownership import holds_only_own, is_own
from kgs.app.files.results_folder import photo_staging
from kgs.datasets.folders import CAMERAS_REPORT
from kgs.errors import DataError
from kgs.json_files import read_json

REPORT = CAMERAS_REPORT
IMAGES = "images"
MASKS = "masks"
MODEL = "sparse/0"


def check_place(out: Path, folder: Path) -> None:
    """Raise a DataError if results would lie among the user's photos, or replace files that kgs did not write."""
    advice = "choose another folder"
    photos = folder.resolve()
    staging = photo_staging(out)
    results = [out / IMAGES, out / MASKS, out / "sparse"]
    temporary = [staging.unfinished, staging.finished]
    if photos == out.resolve() or any(photos.is_relative_to(path.resolve()) for path in [*results, *temporary]):
        raise DataError(out, "", f"holds the photos themselves: {advice}")
    for path in filter(os.path.lexists, [*results, *temporary]):
        if not (holds_only_own(path) or (path in temporary and is_own(path))):
            raise DataError(path, "", f"holds files of a scene that kgs did not write: {advice}")


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
