"""`kgs fit` of bare photos: their cameras first, and then a scene like any other, in the folder of the results."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from kgs.datasets.layouts import CAMERAS_REPORT, nearest_scene
from kgs.datasets.scene import Scene
from kgs.errors import DataError
from kgs.fit.config import FAST, FitConfig
from kgs.fit.folder import load_fit
from kgs.fit.outputs import write_json
from kgs.fit.page import refresh_page
from kgs.fit.progress import each, say
from kgs.json_files import read_json

LONGEST = 504  # pixels of the longer side in a fit on a CPU
FEW = 9  # photos: of fewer none is held out


def is_bare(scene: Path) -> bool:
    """Whether a folder can only be one of photos without cameras: it is no scene, and none is right below or above."""
    return scene.is_dir() and nearest_scene(scene) is None


def find_scene(
    photos: Path, out: Path, request: dict[str, Any], *, seed: int, device: str, estimated: bool = False
) -> dict[str, Any]:
    """Find the cameras of bare photos, and return how the scene in `out` is to be loaded.

    Args:
        photos: the folder of the photos.
        out: that of the results, which gets `images`, `sparse/0` and `photos.json`.
        request: what the user asked for; None stands for what was left open.
        seed: of the solvers.
        device: of the fit; on a CPU the photos are fitted at `LONGEST` pixels unless `request` says else.
        estimated: whether `add_estimate` is to follow.

    Raises:
        DataError: as of `pose_photos`, or there are too few photos for an estimate.
    """
    from . import pose_photos
    from .estimate import LEAST_PHOTOS
    from .find import list_photos

    if estimated and (count := len(list_photos(photos))) < LEAST_PHOTOS:
        raise DataError(
            photos, "", f"--estimate: expected at least {LEAST_PHOTOS} photos to leave one out, got {count}"
        )
    report = pose_photos(photos, out, seed=seed, stage=each, say=say)
    count, longest = len(report["photos"]), max(report["size"])
    if request["hold_out"] is None and count < FEW:
        request = request | {"hold_out": 0}
    if request["downscale"] is None and device == "cpu":
        request = request | {"downscale": max(1.0, longest / LONGEST)}
    return request | {"scene": "."}


def add_estimate(photos: Path, out: Path, scene: Scene, config: FitConfig) -> dict[str, Any]:
    """Estimate how good views are that no photo shows, and add it to metrics.json and to the page of a finished fit."""
    from .estimate import estimate

    known = read_json(out / CAMERAS_REPORT)["photos"]
    fast = replace(FAST, seed=config.seed, backend=config.backend, device=config.device)
    found = estimate(photos, list(known), fast, max(scene.train.images.shape[-2:]), stage=each)
    metrics = read_json(out / "metrics.json") | {"estimate": found}
    write_json(out / "metrics.json", metrics)
    refresh_page(out, load_fit(out, config.device), scene, metrics)
    return metrics
