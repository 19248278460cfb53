"""One cell of the study: one fit, and everything the report needs of it."""

import time
import warnings
from dataclasses import asdict, fields, replace
from datetime import UTC, datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from kgs._support.errors import DataError
from kgs._support.machine import peak_rss_mb, revision
from kgs.app.page.pictures import Picture, encoded
from kgs.bench.scenes import SYNTHETIC
from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.field import field_size
from kgs.datasets.scene import Scene
from kgs.datasets.source import SceneSource
from kgs.fit.config import PRESETS, FitConfig
from kgs.fit.fit import Fit
from kgs.fit.measures import measure
from kgs.fit.run import Hooks, choose_points, fit_scene
from kgs.fit.trainer import Trainer
from kgs.init_points import InitialPoints
from kgs.metrics.evaluate import MEASURES
from kgs.metrics.lpips import Lpips

from .grid import Cell, tell
from .overfitting import coadaptation, count_over_threshold
from .presets import name_of
from .rivals import Rival, RivalTrainer

_TOLD = 4  # parts of the steps, after each of which a running cell says how far it is


@lru_cache(maxsize=1)
def load_lpips(folder: str | None) -> Lpips | None:
    """The network with the weights in this folder; None without one."""
    return None if folder is None else Lpips.load(folder)


def sparse_cell(cell: Cell, data: str | None = None, lpips_weights: str | None = None) -> dict[str, Any]:
    """Fit once and measure. Fits of one scene, views, start and seed share initial points and the order of views.

    Args:
        cell: "scene" ("synthetic", or a folder below `data`), "views", "downscale", "start" (a kind of initial
            points), "method" (a name, for the report), "seed", and "fit": a "preset" of kgs fit (paper unless given),
            and the fields of FitConfig and of Rival that are not as it has them.
        data: the folder of the scenes; DataError: the scene is not there or damaged.
        lpips_weights: a folder with the weights of VGG16 and LPIPS, or None to leave LPIPS out.
    """
    begin = (cell[key] for key in ("scene", "views", "downscale", "start", "seed"))
    scene, points, seconds = _start(data, *begin, cell["fit"].get("preset", "paper"))
    lpips = load_lpips(lpips_weights)
    config, rival = fit_config(cell["start"], cell["seed"], cell["fit"])
    trainer, fit, result = fit_and_measure(scene, config, points, lpips, rival, name_of(cell))
    if cell["scene"] == SYNTHETIC and cell["seed"] == 0:  # of other scenes no photo may be published
        result["pictures"] = _pictures(fit)
    result["test_views"] = {view["name"]: view["psnr"] for view in fit.metrics["test"]["views"]}
    result["init"] |= {"seconds": round(seconds, 2)}
    result["coadaptation"] = coadaptation(trainer.model, scene.test, near_plane=fit.options.near_plane)
    result["thresholds"] = count_over_threshold(trainer, points.points)
    return result


def fit_and_measure(
    scene: Scene,
    config: FitConfig,
    points: InitialPoints,
    lpips: Lpips | None = None,
    rival: Rival | None = None,
    name: str = "",
) -> tuple[Trainer, Fit, dict[str, Any]]:
    """One trainer, its fit with metrics, and what every cell stores of it.

    "cpu_seconds" are those of training, curve and leaving out, "wall_seconds" those of the training alone.
    `rival` replaces random dropping; where a grid has started the fit, it shows how far the one of this name is.
    """

    def tell_quarters(trainer: Trainer, _: float) -> bool:
        steps = trainer.plan.schedule.steps
        part = _TOLD * trainer.step // steps
        if _TOLD * (trainer.step - 1) // steps < part < _TOLD:
            tell(f"{name}: {trainer.step} of {steps} steps")
        return False

    begin = time.process_time()
    trainers = list[Trainer]()
    make_trainer = Trainer if rival is None else partial(RivalTrainer, rival=rival)
    hooks = Hooks(make_trainer=make_trainer, begun=trainers.append, after_step=tell_quarters)
    fit = fit_scene(scene, config, points=points, hooks=hooks)
    (trainer,) = trainers
    cpu_seconds = time.process_time() - begin
    fit = fit.annotated(metrics=measure(fit, lpips))
    stored = {
        **{part: {name: fit.metrics[part][name] for name in MEASURES} for part in ("test", "train")},
        "init": {**fit.history["init"]},
        "protocol": {**fit.metrics["protocol"]},
        "cpu_seconds": round(cpu_seconds, 2),
        "curve": fit.history["curve"],
        "gaussians": len(fit.model),
        "decisions": fit.decisions.to_dict(),
        "config": trainer.plan.config.to_dict() | ({} if rival is None else asdict(rival)),
        "seen": fit.metrics["seen"],
        "wall_seconds": fit.history["seconds"],
        "peak_rss_mb": peak_rss_mb(),
        "versions": fit.metrics["versions"],
        "revision": revision(Path(__file__).parents[1]),
        "date": datetime.now(UTC).date().isoformat(),
    }
    return trainer, fit, stored


def _pictures(fit: Fit) -> list[str]:
    """The first test view, its render and their difference, for the page."""
    views = fit.scene.test
    render = fit.render(views.camera(0))[0]
    (picture,) = encoded([Picture(views.names[0], views.images[0], {"": render})], 2**20)
    return [picture["photo"], *picture["renders"][0][1:]]


@lru_cache(maxsize=1)  # cells of one start follow each other
def _start(
    data: str | None, name: str, views: int, downscale: float | None, start: str, seed: int, preset: str
) -> tuple[Scene, InitialPoints, float]:
    """A scene, in the size of published tables or `downscale` times smaller, its initial points, and their seconds."""
    if name == SYNTHETIC:
        scene = synthetic_scene(train_views=views, size=(72, 96))
    elif data is None:
        raise DataError(name, "", "the environment variable KGS_DATA to name the folder of this scene")
    else:
        points_of = start if start == "model-points" else "none"
        source = SceneSource(Path(data) / name)
        photo_folder, factor, _ = field_size(source)
        shrink = None if downscale is None and factor is None else (downscale or 1.0) * (factor or 1.0)
        scene = load_scene(source, views, shrink, points=points_of, photo_folder=photo_folder)
    config, _ = fit_config(start, seed, {"preset": preset})
    begin = time.process_time()
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # `kind` records a fallback
        points = choose_points(scene, config)
    return scene, points, time.process_time() - begin


def fit_config(start: str, seed: int, fit: dict[str, Any]) -> tuple[FitConfig, Rival | None]:
    """A cell's preset (paper unless `fit` names one) with its start, seed and other settings, and its rival if any."""
    settings: dict[str, Any] = {"init": start, "seed": seed, **fit}
    preset = settings.pop("preset", "paper")
    of_rival = {field.name: settings.pop(field.name) for field in fields(Rival) if field.name in settings}
    return replace(PRESETS[preset], **settings), Rival(**of_rival) if of_rival else None
