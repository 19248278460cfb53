"""How good a view is that no photo shows, where none was held out: each photo is left out once."""

import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from statistics import fmean, stdev
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import torch

from kgs.datasets import load_scene
from kgs.datasets.images import Intrinsics, rectification, remap, resize
from kgs.datasets.layouts.colmap import load_colmap
from kgs.datasets.scene import Scene, Views
from kgs.errors import DataError
from kgs.fit.config import FitConfig
from kgs.fit.run import choose_points
from kgs.fit.trainer import Trainer
from kgs.io.console import Stage, silent

from . import pose_photos
from .locate import locate
from .read import read_photos

LEAST_PHOTOS = 4


def estimate(
    folder: Path,
    names: list[str],
    config: FitConfig,
    longest: float,
    *,
    background: str = "black",
    stage: Stage = silent,
) -> dict[str, Any]:
    """Leave each photo out once: cameras and first points anew without it, a fit, and its camera found by PnP.

    A similarity transform from the cameras of all photos would blame the renders for its own error.

    Args:
        folder: that of the photos.
        names: of at least `LEAST_PHOTOS` photos in it.
        config: of each fit, `FAST` for instance.
        longest: pixels of the longer side in each fit.
        background: behind photos with transparency, as of `load_scene`.
        stage: shows how far it is, as `kgs.io.console.each` does.

    Returns:
        "psnr" (mean, dB), "sd" and "n" over the photos that could be judged, and "photos": for each its "name" with
        "psnr", or with "why" it could not be judged. The mean is None where none could, the deviation with one.
    """
    rows = list[dict[str, Any]]()
    for left_out in stage(names, "photos left out", "photo"):
        with TemporaryDirectory(prefix="kgs-") as place:
            photos, out = Path(place) / "photos", Path(place) / "out"
            photos.mkdir()
            for name in set(names) - {left_out}:
                shutil.copyfile(folder / name, photos / name)
            try:
                pose_photos(photos, out, seed=config.seed, say=lambda line: None)
            except DataError:
                rows.append({"name": left_out, "why": "without it the cameras of the others are not sure"})
                continue
            level = _level(out, folder / left_out, config, longest, background)
            judged = {"why": "too little of it is in the others"} if level is None else {"psnr": level}
            rows.append({"name": left_out} | judged)
    levels = [row["psnr"] for row in rows if "psnr" in row]
    spread = round(stdev(levels), 3) if len(levels) > 1 else None
    return {"psnr": round(fmean(levels), 3) if levels else None, "sd": spread, "n": len(levels), "photos": rows}


def _level(out: Path, left_out: Path, config: FitConfig, longest: float, background: str) -> float | None:
    """The PSNR of a photo in a fit of the others, whose cameras are in `out`; None where it cannot be placed."""
    lens = load_colmap(out).frames[0].intrinsics
    smaller = max(1.0, max(lens.width, lens.height) / longest)
    scene = load_scene(out, downscale=smaller, hold_out=0, background=background)
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        trainer = Trainer(scene, config, choose_points(scene, config))
    trainer.fit()
    photo = _as_view(left_out, lens, scene)
    camera = locate(trainer, photo)
    return None if camera is None else trainer.psnr(replace(photo, cameras=camera))


def _as_view(path: Path, lens: Intrinsics, scene: Scene) -> Views:
    """A photo as those of the scene are: upright, undistorted by their lens, in their size; its pose means nothing."""
    pixels = read_photos([path], silent)[0].pixels.astype(np.float32) / 255
    if pixels.shape[2] == 4:
        pixels = pixels[..., :3] * pixels[..., 3:] + scene.background.numpy() * (1 - pixels[..., 3:])
    whole = np.asarray(cv2.resize(pixels, (lens.width, lens.height), interpolation=cv2.INTER_AREA), np.float32)
    pinhole, maps = rectification(lens)
    height, width = scene.train.images.shape[-2:]
    image, _ = resize(remap(whole, maps), pinhole, width, height)
    photo = torch.from_numpy(image).permute(2, 0, 1)[None]
    return Views(scene.train.camera(0), photo, (path.name,), light=scene.train.light)
