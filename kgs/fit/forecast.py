"""What `kgs fit` takes in time and memory on this machine, announced before it begins.

All constants are fitted to runs on the machine of docs/measured.md, an idle one with two cores. Another machine
renders, and finds keypoints, so many times faster or slower; this is measured once and kept in the user's cache folder.
"""

import os
import statistics
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from kgs.backends import resolve
from kgs.camera import pinhole_cameras
from kgs.errors import DataError
from kgs.init_points.dense import FEWEST, MOST, PIXELS_OF_A_POINT
from kgs.io.film import FRAMES, LONGEST
from kgs.json_files import read_json, write_json
from kgs.machine import check_device, versions
from kgs.renderer import GaussianRenderer
from kgs.types import Gaussians

from .config import FitConfig, most_gaussians, timetable, with_pace
from .probes import MIN_VIEWS, SHARE

# Seconds of `_render` on the machine that the other constants are from, by backend; of torch so many that the ratio to
# them is that of a step. And of `_find_keypoints`.
_RENDER_SECONDS = {"numba": 0.0063, "torch": 0.0034}
_KEYPOINT_SECONDS = 0.097
_START = 3.0  # seconds until Python has loaded everything
_CAMERAS = (12.0, 1.3, 0.55)  # seconds of finding cameras in photos of `_PHOTO_PIXELS`: once, for each photo and pair
_PHOTO_PIXELS = 1.7e6
_AGREED = 0.5  # of the pixels have a depth that two views agree on
_VIEW = 1.5  # seconds of initial points for each view
_STEP = (0.005, 5.6e-7, 1.6e-7)  # seconds of a training step: once, for each Gaussian and pixel
_PROBE = 1.3  # seconds of a probe's step, over those of a step of the fit with as many pixels
_FRAME = (0.55, 2e-7)  # seconds of a frame of the film, over those of a step, and for each pixel besides
_PAGE = 6.0  # seconds of measures, page and other files
_MEMORY = (930 * 2.0**20, 1000.0, 115.0)  # bytes: of the program, for each Gaussian, for each pixel of all views


class Forecast(NamedTuple):
    """Seconds of each stage, in their order, empty on a GPU; and bytes of the process at its peak."""

    seconds: dict[str, float]
    memory: float

    def __str__(self) -> str:
        memory = f"{self.memory / 2**30:.1f} GiB of memory"
        if not self.seconds:
            return f"this takes about {memory}"
        parts = ", ".join(f"{name} {_duration(part)}" for name, part in self.seconds.items())
        return f"this takes about {_duration(sum(self.seconds.values()))} ({parts}) and {memory}"


def forecast(
    views: int, size: tuple[int, int], config: FitConfig, photos: int = 0, photo_pixels: float = 0.0
) -> Forecast:
    """Time and memory of `kgs fit`, from its start to the page.

    Args:
        views: number of training views.
        size: height and width of the images in the fit.
        config: of the fit.
        photos: number of photos whose cameras are to be found first; 0 if they are known.
        photo_pixels: pixels of one of these photos, as the cameras are found in it.
    """
    pixels = float(size[0] * size[1])
    likely = _AGREED * views * pixels / PIXELS_OF_A_POINT
    steps = timetable(with_pace(config, views)).steps
    points = config.init_points or round(min(max(likely, FEWEST), MOST))
    gaussians = min(most_gaussians(config, points), 1.3 * points)
    base, per_gaussian, per_pixel = _MEMORY
    memory = base + per_gaussian * gaussians + per_pixel * views * pixels
    device = check_device(config.device)
    if device.type != "cpu":
        return Forecast({}, memory)
    renders, keypoints = slowness(resolve(config.backend, device))

    def step(pixels: float, gaussians: float = gaussians) -> float:
        once, per_gaussian, per_pixel = _STEP
        return renders * (once + per_gaussian * gaussians + per_pixel * pixels)

    coarse = config.coarse * steps
    film = min(1.0, LONGEST / max(size)) ** 2 * pixels
    seconds = {"start": _START * keypoints}
    if photos:
        once, per_photo, per_pair = _CAMERAS
        whole = once + per_photo * photos + per_pair * photos * (photos - 1) / 2
        seconds["cameras"] = keypoints * whole * (photo_pixels / _PHOTO_PIXELS) ** 0.5
    if config.init == "dense":
        seconds["initial points"] = renders * _VIEW * views
    if config.sh_degree is None and views >= MIN_VIEWS:
        small = min(gaussians, 0.1 * pixels)
        seconds["probes"] = _PROBE * SHARE * steps * step(pixels / 4, small) + renders * _VIEW * views / 2
    seconds["fit"] = coarse * step(pixels / 4) + (steps - coarse) * step(pixels)
    seconds["film and page"] = FRAMES * (_FRAME[0] * step(film) + _FRAME[1] * film * keypoints) + _PAGE * keypoints
    return Forecast(seconds, memory)


def _duration(seconds: float) -> str:
    """A duration in words, rounded as far as it is known."""
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.1f} minutes"


def slowness(backend: str) -> tuple[float, float]:
    """How many times as long as on the reference machine rendering takes with a backend, and finding keypoints.

    It is measured in a second, once for each machine, backend and version, and kept in `kgs/speed.json` of the user's
    cache folder (XDG_CACHE_HOME, ~/.cache). If it cannot be written, it is measured each time.
    """
    path = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "kgs" / "speed.json"
    key = ", ".join([backend, f"{torch.get_num_threads()} threads", *map(" ".join, versions().items())])
    kept: dict[str, list[float]] = {}
    with suppress(DataError, OSError):
        kept = read_json(path)
    try:
        renders, keypoints = map(float, kept[key])
    except (KeyError, TypeError, ValueError):
        renders, keypoints = _median_seconds(_render(backend)), _median_seconds(_find_keypoints)
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, {**kept, key: [renders, keypoints]})
    return renders / _RENDER_SECONDS[backend], keypoints / _KEYPOINT_SECONDS


def _median_seconds(work: Callable[[], object]) -> float:
    """Seconds of a call, after one that is not counted."""
    work()
    seconds = []
    for _ in range(7):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return statistics.median(seconds)


def _render(backend: str) -> Callable[[], object]:
    """Renders random Gaussians and their gradients."""
    count = 10_000 if backend != "torch" else 2_000
    generator = torch.Generator().manual_seed(0)
    draws = torch.rand(count, 14, generator=generator)
    gaussians = Gaussians(
        means=torch.cat([2 * draws[:, :2] - 1, 2 + draws[:, 2:3]], 1),
        quats=draws[:, 3:7] - 0.5,
        scales=0.005 + 0.015 * draws[:, 7:10],
        opacities=0.9 * draws[:, 10],
        colors=draws[:, 11:].clone().requires_grad_(),
    )
    k = torch.tensor([[200.0, 0.0, 125.5], [0.0, 200.0, 94.0], [0.0, 0.0, 1.0]])
    camera = pinhole_cameras(torch.eye(4), k, 252, 189)
    renderer = GaussianRenderer(backend=backend)
    return lambda: renderer(gaussians, camera).image.sum().backward()


def _find_keypoints() -> object:
    """Finds SIFT keypoints in a random texture."""
    noise = np.random.default_rng(0).integers(0, 256, (480, 640)).astype(np.uint8)
    return cv2.SIFT.create(2000).detectAndCompute(cv2.GaussianBlur(noise, (0, 0), 1.5), None)
