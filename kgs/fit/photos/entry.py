"""`kgs fit` of bare photos: their cameras first, and then a scene like any other, in the folder of the results."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from kgs.datasets.images import VIDEO_SUFFIXES
from kgs.datasets.layouts import CAMERAS_REPORT, nearest_scene
from kgs.datasets.scene import Scene
from kgs.errors import DataError
from kgs.fit.config import FAST, FitConfig, most_gaussians
from kgs.fit.minutes import expected_minutes
from kgs.fit.saved import load_fit
from kgs.io.console import each, say
from kgs.io.json_files import read_json, write_json
from kgs.io.results_folder import locked
from kgs.machine import bytes_of
from kgs.page.fit_page import refresh_page

LONGEST = 504  # pixels of the longer side in a fit on a CPU
_PHOTO, _PIXEL = 2.0, 1.3e-6  # seconds for the camera of a photo and for each of its pixels, on an AMD EPYC
_POSING, _DECODING = 500e6, 50.0  # bytes, and bytes for each pixel of the largest photo
FEW = 9  # photos: of fewer none is held out


def is_bare(scene: Path) -> bool:
    """Whether this can only be photos without cameras, or a video of them: no scene, and none right below or above."""
    if scene.is_file():
        return scene.suffix.lower() in VIDEO_SUFFIXES
    return scene.is_dir() and nearest_scene(scene) is None


def find_scene(
    photos: Path, out: Path, request: dict[str, Any], config: FitConfig, *, estimated: bool = False
) -> tuple[dict[str, Any], Path]:
    """Find the cameras of bare photos; returns how the scene is to be loaded, as config.json has it, and from where.

    That folder is `out`, or one in it until the new fit takes the place of a former one: see `pose_photos`.

    Args:
        photos: the folder of the photos.
        out: that of the results, which gets `images`, `sparse/0` and `photos.json`.
        request: what the user asked for; None stands for what was left open.
        config: of the fit; on a CPU the photos are fitted at `LONGEST` pixels unless `request` says else.
        estimated: whether `add_estimate` is to follow.

    Raises:
        DataError: as of `pose_photos`, or there are too few photos for an estimate.
    """
    from . import pose_photos
    from .estimate import LEAST_PHOTOS
    from .find import find_photos

    if estimated and (count := len(find_photos(photos))) < LEAST_PHOTOS:
        raise DataError(
            photos, "", f"--estimate: expected at least {LEAST_PHOTOS} photos to leave one out, got {count}"
        )
    if not (out / CAMERAS_REPORT).exists() and (told := foretold(photos, request["downscale"], config)):
        say(told)
    report = pose_photos(photos, out, seed=config.seed, wait=True, stage=each, say=say)
    count, longest = len(report["photos"]), max(report["size"])
    if request["hold_out"] is None and count < FEW:
        request = request | {"hold_out": 0}
    downscale = _downscale(request["downscale"], longest, config)
    request = request | {"downscale": downscale, "scene": ".", "title": photos.resolve().name}
    return request, Path(report["folder"])


def settle(out: Path) -> None:
    """Put cameras that waited for a fit in their place, beside its results."""
    from .write import end_move

    with locked(out):
        end_move(out)


def foretold(photos: Path, downscale: float | None, config: FitConfig) -> str:
    """What cameras and fit will take, in words, from the sizes of the photos alone: times within a factor of two.

    "" where the photos cannot be read, which :func:`pose_photos` says better.
    """
    from .find import find_photos
    from .read import LONGEST as POSED
    from .read import upright_size

    try:
        paths = find_photos(photos)
        sizes = [upright_size(path) for path in paths]
    except DataError:
        return ""
    width, height = min(sizes)
    posed = min(1.0, POSED / max(width, height))
    seconds = len(paths) * (_PHOTO + _PIXEL * width * height * posed**2)
    shrunk = posed / (_downscale(downscale, posed * max(width, height), config) or 1.0)
    images = torch.empty(len(paths), 3, max(1, round(height * shrunk)), max(1, round(width * shrunk)), device="meta")
    minutes = config.minutes or expected_minutes(images[0, 0].numel(), config)
    fitting = config.max_bytes + bytes_of(most_gaussians(config, config.init_points), images)
    most = max(fitting, _POSING + _DECODING * max(wide * high for wide, high in sizes))
    times = f"cameras in about {seconds:.0f} s, the fit in {60 * minutes:.0f} s"
    return f"{len(paths)} photos, the smallest of {width}x{height}: {times}, at most {most / 2**30:.1f} GiB of memory"


def _downscale(asked: float | None, longest: float, config: FitConfig) -> float | None:
    """By how much posed photos are shrunk for the fit; `longest` is their longer side in pixels."""
    return max(1.0, longest / LONGEST) if asked is None and config.device == "cpu" else asked


def add_estimate(photos: Path, out: Path, scene: Scene, config: FitConfig, background: str) -> dict[str, Any]:
    """Estimate how good views are that no photo shows, and add it to metrics.json and to the page of a finished fit."""
    from .estimate import estimate

    known = read_json(out / CAMERAS_REPORT)["photos"]
    fast = replace(FAST, seed=config.seed, backend=config.backend, device=config.device)
    longest = max(scene.train.images.shape[-2:])
    found = estimate(photos, list(known), fast, longest, background=background, stage=each)
    metrics = read_json(out / "metrics.json") | {"estimate": found}
    write_json(out / "metrics.json", metrics)
    refresh_page(out, load_fit(out, config.device), scene, metrics)
    return metrics
