"""What is settled before a fit begins: its settings, its device and backend, and the steps at which things happen."""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Self

import torch

from kgs._support.checks import check_kind
from kgs._support.default_device import cpu_by_default
from kgs._support.machine import check_device
from kgs.backends import get_backend
from kgs.datasets.scene import Scene
from kgs.init_points import InitialPoints
from kgs.init_points.dense import FEW_VIEWS

from .config import FitConfig, Settings
from .decisions import Decisions
from .exposure import decide_exposure
from .overlap import FEW, decide_by_overlap, usual_decay
from .sh_degree import decide_degree

ERROR_POINTS_UNTIL = 0.6  # share of the steps after which no points are added where the error is


class Schedule(NamedTuple):
    """The steps at which a fit of a given length does what is due only now and then."""

    steps: int  # all of them
    sh: tuple[int, ...]  # before these one more degree of harmonics is switched on
    densify: tuple[int, ...]  # after these Gaussians are cloned, split and pruned
    error_points: tuple[int, ...]  # after these, which are densifications, Gaussians are added where the error is
    reset: tuple[int, ...]  # after these all opacities are lowered
    haze: tuple[int, ...]  # after these Gaussians that veil a training view fade
    evaluate: tuple[int, ...]  # after these the curve is measured (before a densification)
    drop: int  # up to this one Gaussians are dropped
    coarse: int  # up to this one the training views are seen at half their width


@dataclass(frozen=True)
class Plan:
    """What is settled before a fit begins, by :func:`make_plan`.

    Args:
        config: the settings, none of them open.
        device: of the fit.
        backend: "numba", "triton" or "torch".
        max_gaussians: the number of Gaussians at which densification stops.
        schedule: the steps at which things happen.
        decisions: what was decided about the scene, and why.
    """

    config: Settings
    device: torch.device
    backend: str
    max_gaussians: int
    schedule: Schedule
    decisions: Decisions

    def __post_init__(self) -> None:
        check_kind("config", self.config, Settings)

    @classmethod
    def of(cls, config: Settings, points: int, decisions: Decisions) -> Self:
        """The plan of a fit that begins with so many points. Errors: those of :func:`check_machine`."""
        device, backend = check_machine(config)
        limit = config.max_gaussians or max(10 * config.steps, 3 * points // 2)
        return cls(config, device, backend, limit, make_schedule(config), decisions)


@cpu_by_default
def make_plan(scene: Scene, config: FitConfig, points: InitialPoints) -> Plan:
    """Settle all that a configuration leaves open.

    Args:
        scene: the scene to fit.
        config: the settings as they were asked for; what they give stays as it is.
        points: the initial points of the fit. "dense" and "sift" tell how many photos show the same surface, whether
            colours depend on the direction, and how much brighter one photo is than the others.

    Raises:
        TypeError: an argument is of another type.
        ValueError: the device cannot be used, or the backend does not run on it.
        ModuleNotFoundError: the backend is numba or triton, and it is not installed.
    """
    check_kind("scene", scene, Scene)
    check_kind("config", config, FitConfig)
    check_kind("points", points, InitialPoints)
    is_few = len(scene.train) <= FEW_VIEWS
    steps = FEW.steps if config.steps is None and is_few else config.steps
    steps, drop, overlap = decide_by_overlap(points.patches, steps, config.drop)
    degree = None if config.sh_degree is not None else decide_degree(points)
    decay = config.recipe.opacity_decay
    settings = Settings.of(
        config,
        steps=steps,
        drop=drop,
        sh_degree=config.sh_degree if degree is None else degree.chosen,
        coarse=config.coarse or 0.0,
        opacity_decay=usual_decay(is_few, steps) if decay is None else decay,
    )
    exposure = decide_exposure(points.patches, config.exposure)
    return Plan.of(settings, len(points.points), Decisions(degree, overlap, exposure))


def check_machine(config: FitConfig) -> tuple[torch.device, str]:
    """The device and the backend of a fit.

    Raises:
        ValueError: the device cannot be used, or the backend does not run on it.
        ModuleNotFoundError: the backend is numba or triton, and it is not installed.
    """
    device = check_device(config.device)
    return device, get_backend(config.backend, device).name


def make_schedule(config: Settings) -> Schedule:
    """Scale the recipe's counts by steps / `recipe.steps`.

    A short fit shortens the densification interval only as far as it needs to densify about 20 times, and never below
    10 steps: with mean gradients over few steps the number of Gaussians explodes. `reset_recovery` skips resets. Looks
    for haze are at least 50 steps apart: before that a fit is too rough to tell a veil from what is not fitted yet.
    """
    recipe = config.recipe
    steps = config.steps
    scale = steps / recipe.steps
    interval = max(10, round(min(recipe.densify_interval, steps / 20) * max(1.0, scale)))
    spacing = max(1, round(recipe.reset_interval * scale)) if recipe.reset_interval else steps
    resets = [*range(spacing, steps, spacing), steps]
    looks = max(50, round(recipe.haze_interval * scale)) if recipe.haze_interval else steps
    evaluations = range(1, config.evaluations + 1)
    densifications = [s for s in range(interval, steps, interval) if s > round(recipe.densify_from * scale)]
    return Schedule(
        steps=steps,
        sh=tuple(max(1, round(recipe.sh_interval * scale * k)) for k in range(1, config.sh_degree + 1)),
        densify=tuple(densifications),
        error_points=tuple(s for s in densifications if recipe.error_points and s <= ERROR_POINTS_UNTIL * steps),
        reset=tuple(s for s, following in pairwise(resets) if following - s >= recipe.reset_recovery),
        haze=tuple(range(looks, round(0.9 * steps) + 1, looks)),
        evaluate=tuple(sorted({max(1, round(steps * k / config.evaluations)) for k in evaluations})),
        drop=steps - min(config.no_drop_steps, round(0.1 * steps)),
        coarse=round(config.coarse * steps),
    )


# Bytes, fitted to measured runs: of the program, for each Gaussian, for each pixel of all training views.
_MEMORY = (930 * 2.0**20, 1000.0, 115.0)


def expected_memory(scene: Scene, gaussians: int) -> float:
    """Bytes of the process at the peak of a fit with so many Gaussians."""
    of_program, of_gaussian, of_pixel = _MEMORY
    return of_program + of_gaussian * gaussians + of_pixel * scene.train.images[:, 0].numel()
