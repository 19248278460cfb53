"""One cell of the study: one fit, everything that the report says of it, and two probes of the fitted model."""

import subprocess
import time
import warnings
from dataclasses import replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import kgs
from kgs.bench.scenes import SYNTHETIC
from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.scene import Scene, Views
from kgs.errors import DataError
from kgs.fit.config import PRESETS, FitConfig
from kgs.fit.lpips import Lpips
from kgs.fit.machine import peak_rss_mb
from kgs.fit.metrics import MEASURES
from kgs.fit.needs import decide
from kgs.fit.run import choose_points, measure
from kgs.fit.slim import slim
from kgs.fit.starts import FirstPoints
from kgs.fit.starts.triangulate import camera_centers
from kgs.fit.trainer import Trainer
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer

FULL = "full-model"  # a start that no fit may have: the upper bound
_FULL_MODEL = f"{FULL}: points seen in any two photos that are no test views, refined with test views; not allowed"
BINS = 6
_lpips = lru_cache(maxsize=1)(Lpips.load)


def sparse_cell(cell: dict[str, Any], data: str | None = None, lpips_weights: str | None = None) -> dict[str, Any]:
    """Fit once and measure; fits of the same scene, views, start and seed begin alike and see the views in one order.

    Args:
        cell: "scene" ("synthetic", or a folder below `data`), "views", "downscale", "start" (a kind of first points, or
            "full-model": 10 000 of the points that a COLMAP model has of all photos that are no test views),
            "method" (a name, for the report), "seed", and "fit": a "preset" of kgs fit (paper unless given), and the
            fields of FitConfig that are not as it has them.
        data: the folder of the scenes; DataError: the scene is not there or damaged.
        lpips_weights: a folder with the weights of VGG16 and LPIPS, or None to leave LPIPS out.
    """
    preset = cell["fit"].get("preset", "paper")
    known = (cell[key] for key in ("scene", "views", "downscale", "start", "seed"))
    scene, points, seconds = _start(data, *known, preset)
    lpips = None if lpips_weights is None else _lpips(lpips_weights)
    trainer, metrics, result = fit_and_measure(scene, _config(**cell), points, lpips)
    return result | {
        **{part: {name: metrics[part][name] for name in MEASURES} for part in ("test", "train")},
        "test_views": {view["name"]: view["psnr"] for view in metrics["test"]["views"]},
        "init": {**trainer.init, "seconds": round(seconds, 2)},
        "coadaptation": coadaptation(trainer.model, scene.test, near_plane=trainer.renderer.near_plane),
        "thresholds": count_over_threshold(trainer, points.points),
        "protocol": metrics["protocol"] | ({"init": _FULL_MODEL} if cell["start"] == FULL else {}),
    }


def fit_and_measure(
    scene: Scene, config: FitConfig, points: FirstPoints, lpips: Lpips | None = None
) -> tuple[Trainer, dict[str, Any], dict[str, Any]]:
    """One fit, its metrics, and what every cell stores of it; "cpu_seconds" are of the training and its curve."""
    start = time.process_time()
    config, needs = decide(scene, config, choose_points)
    trainer = Trainer(scene, config, points)
    trainer.needs |= needs
    trainer.fit()
    slim(trainer)
    stored: dict[str, Any] = {"cpu_seconds": round(time.process_time() - start, 2)}
    metrics = measure(trainer, lpips)
    stored |= {"curve": trainer.curve, "gaussians": len(trainer.shown), "needs": trainer.needs}
    stored |= {"config": trainer.config.to_dict()}
    stored |= {"wall_seconds": round(trainer.seconds, 2), "peak_rss_mb": peak_rss_mb(), "versions": metrics["versions"]}
    stored |= {"revision": revision(Path(kgs.__file__).parent), "date": datetime.now(UTC).date().isoformat()}
    return trainer, metrics, stored


def revision(path: Path) -> str | None:
    """The commit that last changed a file or folder, as "1a2b3c4 of 2026-11-22"; None where git does not know it."""
    options = (("log", "-1", "--format=%h of %cs"), ("status", "--porcelain"))
    calls = (["git", "-C", str(path.parent), *arguments, "--", path.name] for arguments in options)
    try:
        commit, changes = (subprocess.run(c, capture_output=True, text=True, check=True).stdout.strip() for c in calls)
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit + (" and later changes" if changes else "") if commit else None


@lru_cache(maxsize=1)  # cells of one start follow each other
def _start(
    data: str | None, name: str, views: int, downscale: float | None, start: str, seed: int, preset: str = "paper"
) -> tuple[Scene, FirstPoints, float]:
    """A scene, its first points, and the processor's seconds that they took."""
    if name == SYNTHETIC:
        scene = synthetic_scene(train_views=views, size=(72, 96))
    elif data is None:
        raise DataError(name, "", "expected the environment variable KGS_DATA to name the folder of this scene")
    else:
        scene = load_scene(Path(data) / name, views, downscale, points=start if start == "model-points" else "none")
    begin, config = time.process_time(), _config(start, seed, {"preset": preset})
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # a start that fell back says so by its kind
        points = _full_model(scene, seed) if start == FULL else choose_points(scene, config)
    return scene, points, time.process_time() - begin


def _config(start: str, seed: int, fit: dict[str, Any] | None = None, **_: Any) -> FitConfig:
    values = {"preset": "paper", "init": "model-points" if start == FULL else start, "seed": seed, **(fit or {})}
    return replace(PRESETS[values.pop("preset")], **values)


def _full_model(scene: Scene, seed: int) -> FirstPoints:
    """Points of the model that two photos observe, also such as lie between the fit's few views; no test views."""
    everything = load_scene(scene.root, points="model-points")
    chosen = torch.randperm(len(everything.points), generator=torch.Generator().manual_seed(seed))[:10_000]
    points = everything.points[chosen].double() + (everything.offset - scene.offset)
    return FirstPoints(points.float(), everything.point_colors[chosen], FULL)


@torch.no_grad()
def coadaptation(
    model: GaussianModel, views: Views, *, near_plane: float = 0.01, subsets: int = 5, seed: int = 0
) -> float | None:
    """How much Gaussians rely on each other: the variance of renders of random halves, 0 where all halves look alike.

    Unbiased, of clamped renders whose opacities are not raised; the mean over channels and over the pixels of all views
    that have an alpha above 0.8 in every one of the `subsets` (at least 2) halves; None where there are no such pixels.
    Source: "Quantifying and Alleviating Co-Adaptation in Sparse-View 3D Gaussian Splatting", arXiv 2508.12720.
    """
    if subsets < 2:
        raise ValueError(f"subsets: expected at least 2, got {subsets}")
    renderer, generator = GaussianRenderer(near_plane=near_plane), torch.Generator().manual_seed(seed)
    gaussians, total, pixels = model(), 0.0, 0
    for view in range(len(views)):
        kept = [torch.rand(gaussians.opacities.shape, generator=generator) < 0.5 for _ in range(subsets)]
        halves = (replace(gaussians, opacities=gaussians.opacities * keep) for keep in kept)
        renders = [renderer(half, views.camera(view), outputs=("image", "alpha")) for half in halves]
        covered = torch.stack([out.alpha[0, 0] > 0.8 for out in renders]).all(0)
        images = torch.stack([out.image[0].clamp(0, 1).double() for out in renders])
        total += float(images.var(0).mean(0)[covered].sum())
        pixels += int(covered.sum())
    return total / pixels if pixels else None


def count_over_threshold(trainer: Trainer, first_points: Tensor) -> dict[str, Any]:
    """Count Gaussians, and those whose mean gradient since the last densification is over the threshold, by distance.

    The distance is that to the nearest training camera, in medians of the first points' distances. The edges of the
    bins are quantiles of these; what lies beyond counts in the outer bins. Source: the DropGaussian paper.
    """
    centers = camera_centers(trainer.scene.train.cameras)
    clouds = (first_points, trainer.model.means)
    first, now = (torch.cdist(points.detach().cpu().double(), centers).amin(1) for points in clouds)
    edges = torch.quantile(first, torch.linspace(0, 1, BINS + 1, dtype=first.dtype))
    bins = torch.bucketize(now, edges[1:-1])
    over = trainer.densifier.mean_gradients.cpu() >= trainer.densifier.grad_threshold
    distance = [round(float(edge / first.median()), 4) for edge in edges]
    counts = [torch.bincount(chosen, minlength=BINS).tolist() for chosen in (bins, bins[over])]
    return {"distance": distance, "gaussians": counts[0], "over": counts[1]}
