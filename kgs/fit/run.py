"""A whole fit in one call: initial points, training, and leaving out what the scene does not need."""

from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from typing import Any

from kgs._support.checks import check_kind
from kgs._support.errors import DataError, quoted
from kgs._support.progress import ProgressBar, silent
from kgs.datasets.scene import Scene
from kgs.init_points import InitialPoints as InitialPoints
from kgs.init_points import initial_points as initial_points
from kgs.init_points.in_view import check_in_view

from .config import FitConfig, min_side
from .fit import Fit
from .plan import Plan, check_machine, make_plan
from .pruning import prune
from .trainer import Trainer


def _nothing(*_: object) -> None:
    """The hook of a caller that adds nothing."""


@dataclass(frozen=True)
class Hooks:
    """What a caller adds to a fit.

    Args:
        bar: wraps the loops of the initial points to show their progress, see :mod:`kgs._support.progress`.
        make_trainer: makes the trainer of a fit that begins; for a subclass.
        begun: called with the trainer before the first step.
        after_step: called after each step with the trainer and the loss; True ends the training.
        done: called with the trainer and the fit, after pruning.
    """

    bar: ProgressBar = silent
    make_trainer: Callable[[Scene, Plan, InitialPoints], Trainer] = Trainer
    begun: Callable[[Trainer], object] = _nothing
    after_step: Callable[[Trainer, float], bool] | None = None
    done: Callable[[Trainer, Fit], object] = _nothing


def fit_scene(
    scene: Scene,
    config: FitConfig | None = None,
    *,
    points: InitialPoints | None = None,
    resume: str | PathLike[str] | None = None,
    hooks: Hooks = Hooks(),
) -> Fit:
    """Fit a scene: initial points, plan, training, pruning. `kgs fit` calls it and writes a folder.

    Args:
        scene: posed training and test views; the test views are rendered only for the curve.
        config: the settings; None: the defaults.
        points: the initial points; None: those that `config.init` asks for.
        resume: a checkpoint to continue from, see :meth:`Trainer.resume`; None: the fit begins.
        hooks: what is to happen beside it, as a progress bar or checkpoints.

    Raises:
        DataError: the scene, the file of initial points or the checkpoint is not of use, or images are too small.
        TrainingDiverged: a number is not finite, or a scale explodes.
        ValueError: points are too few, or the device or backend is not available.
    """
    config = FitConfig() if config is None else config
    if resume is not None:
        trainer = Trainer.resume(scene, config, resume)
    else:
        check_before_points(scene, config)
        points = choose_points(scene, config, hooks.bar) if points is None else points
        trainer = hooks.make_trainer(scene, make_plan(scene, config, points), points)
    hooks.begun(trainer)
    fit = prune(trainer.fit(hooks.after_step))
    hooks.done(trainer, fit)
    return fit


def check_before_points(scene: Scene, config: FitConfig, lpips: bool = False) -> None:
    """Check device, backend and the size of the images, before initial points take a minute.

    Args:
        scene: the scene to fit.
        config: the settings of the fit.
        lpips: whether LPIPS, which needs larger images, will be measured.

    Raises:
        TypeError: an argument is of another type.
        DataError: images are too small.
        ValueError, ModuleNotFoundError: as :func:`kgs.fit.plan.check_machine`.
    """
    check_kind("scene", scene, Scene)
    check_kind("config", config, FitConfig)
    check_machine(config)
    smallest = min_side(config, lpips)
    for views in (scene.train, scene.test):
        height, width = views.images.shape[-2:]
        if min(height, width) < smallest:
            raise DataError(scene.root, "images", f"at least {smallest}x{smallest} pixels", f"{width}x{height}")


def choose_points(scene: Scene, config: FitConfig, bar: ProgressBar = silent) -> InitialPoints:
    """Make the initial points that `config.init` asks for.

    Args:
        scene: the scene to fit; test views are not used.
        config: the settings of the fit.
        bar: wraps the loops to show their progress, see :mod:`kgs._support.progress`.

    Raises:
        DataError: the scene, or the file, has none, or no training image shows one.
    """
    kind = config.init
    if kind in ("scene", "model-points"):
        if len(scene.points) == 0:
            raise DataError(scene.root, "points", f"points of the layout itself for the init {kind!r}", "none")
        if (kind == "model-points") != (scene.init_kind == "model-points"):
            expected = f"points for the init {kind!r}"
            advice = "load_scene(points=...) chooses"
            raise DataError(scene.root, "points", expected, quoted(scene.init_kind), advice=advice)
        check_in_view(scene.points, scene.train, scene.root)
        return InitialPoints(scene.points, scene.point_colors, scene.init_kind)
    views = scene.train if scene.train_full_size is None else scene.train_full_size
    options: dict[str, Any] = {
        "device": config.device,
        "seed": config.seed,
        "count": config.init_points,
        "draw": config.draw,
        "pixels": scene.train.images[:, 0].numel(),
        "file": config.init_file,
        "origin": scene.offset,  # files that kgs writes are in the world's coordinates
    }
    points = initial_points(views, kind, bar=bar, backend=config.backend, **options)
    check_in_view(points.points, scene.train, config.init_file or scene.root)
    return points
