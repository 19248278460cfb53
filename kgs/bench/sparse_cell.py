"""One cell of the study of sparse views: one fit and everything that the report says of it."""

from __future__ import annotations

import time
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.scene import Scene
from kgs.errors import DataError
from kgs.fit.config import FitConfig
from kgs.fit.lpips import Lpips
from kgs.fit.metrics import MEASURES
from kgs.fit.outputs import peak_rss_mb
from kgs.fit.run import choose_points, measure
from kgs.fit.starts import FirstPoints
from kgs.fit.trainer import Trainer

from .coadaptation import coadaptation
from .scenes import SYNTHETIC
from .thresholds import count_over_threshold

__all__ = ["sparse_cell"]

SIZE = (72, 96)  # of the synthetic pictures
FULL = "full-model"  # a start that no fit may have: the upper bound
_FULL_MODEL = f"{FULL}: points seen in any two photos that are no test views, refined with test views; not allowed"


def sparse_cell(cell: dict[str, Any], data: str | None = None, lpips_weights: str | None = None) -> dict[str, Any]:
    """Fit once and measure.

    Fits of the same scene, views, start and seed begin with the same points and see the views in the same order.

    Args:
        cell: "scene" ("synthetic", or a folder below `data`), "views", "downscale", "start" (a kind of first points, or
            "full-model": 10 000 of the points that a COLMAP model has of all photos that are no test views),
            "method" (a name, for the report), "seed", and "fit", the fields of FitConfig that are not the default's.
        data: the folder of the scenes, where the cell runs.
        lpips_weights: a folder with the weights of VGG16 and LPIPS, or None to leave LPIPS out.

    Returns:
        Plain values: means of the measures under "test" and "train", "test_views" (PSNR of each), "curve", "init",
        "gaussians", "wall_seconds" of the training, "cpu_seconds" of the training and its curve, "peak_rss_mb",
        "coadaptation", "thresholds", "config" (all settings of the fit), "protocol" and "versions".

    Raises:
        DataError: the scene is not there or damaged.
    """
    scene, points, seconds = _start(data, cell["scene"], cell["views"], cell["downscale"], cell["start"], cell["seed"])
    config = _config(cell["start"], cell["seed"], **cell["fit"])
    trainer = Trainer(scene, config, points)
    start = time.process_time()
    trainer.fit()
    cpu_seconds = time.process_time() - start
    metrics = measure(trainer, None if lpips_weights is None else _lpips(lpips_weights))
    return {
        **{part: {name: metrics[part][name] for name in MEASURES} for part in ("test", "train")},
        "test_views": {view["name"]: view["psnr"] for view in metrics["test"]["views"]},
        "curve": trainer.curve,
        "init": {**trainer.init, "seconds": round(seconds, 2)},
        "gaussians": len(trainer.model),
        "wall_seconds": round(trainer.seconds, 2),
        "cpu_seconds": round(cpu_seconds, 2),
        "peak_rss_mb": peak_rss_mb(),
        "coadaptation": coadaptation(trainer.model, scene.test, near_plane=trainer.renderer.near_plane),
        "thresholds": count_over_threshold(trainer, points.points),
        "config": config.to_dict(),
        "protocol": metrics["protocol"] | ({"init": _FULL_MODEL} if cell["start"] == FULL else {}),
        "versions": metrics["versions"],
    }


@lru_cache(maxsize=1)  # cells of one start follow each other
def _start(
    data: str | None, name: str, views: int, downscale: float | None, start: str, seed: int
) -> tuple[Scene, FirstPoints, float]:
    """A scene, its first points, and the processor's seconds that they took."""
    if name == SYNTHETIC:
        scene = synthetic_scene(train_views=views, size=SIZE)
    elif data is None:
        raise DataError(name, "", "expected the environment variable KGS_DATA to name the folder of this scene")
    else:
        kind = "model-points" if start == "model-points" else "none"
        scene = load_scene(Path(data) / name, views, downscale, points=kind)
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a start that fell back says so by its kind
        points = _full_model(scene, seed) if start == FULL else choose_points(scene, _config(start, seed))
    return scene, points, time.process_time() - begin


def _config(start: str, seed: int, **fit: Any) -> FitConfig:
    return FitConfig(init="model-points" if start == FULL else start, seed=seed, **fit)


def _full_model(scene: Scene, seed: int) -> FirstPoints:
    """Points of the model that two photos observe, also such as lie between the fit's few views; no test views."""
    everything = load_scene(scene.root, points="model-points")
    chosen = torch.randperm(len(everything.points), generator=torch.Generator().manual_seed(seed))[:10_000]
    points = everything.points[chosen].double() + (everything.offset - scene.offset)
    return FirstPoints(points.float(), everything.point_colors[chosen], FULL)


@lru_cache(maxsize=1)
def _lpips(weights: str) -> Lpips:
    return Lpips.load(weights)
