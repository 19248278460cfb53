"""What is settled before a fit begins: its settings, its device and backend, and the steps at which things happen."""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple, Self

import torch

from kgs._support.checks import check_kind
from kgs._support.machine import check_device
from kgs.backends import resolve
from kgs.datasets.scene import Scene
from kgs.init_points.dense import FEW_VIEWS

from .config import FitConfig
from .decisions import Decisions


class Schedule(NamedTuple):
    """The steps at which a fit of a given length does what it does not do in each."""

    steps: int  # all of them
    sh: tuple[int, ...]  # before these one more degree of harmonics is switched on
    densify: tuple[int, ...]  # after these Gaussians are cloned, split and pruned
    reset: tuple[int, ...]  # after these all opacities are lowered
    haze: tuple[int, ...]  # after these Gaussians that veil a training view fade
    evaluate: tuple[int, ...]  # after these the curve is measured (before a densification)
    drop: int  # up to this one Gaussians are dropped
    coarse: int  # up to this one the training views are seen at half their width


class StepDefaults(NamedTuple):
    """The length of a fit, and how fast opacities fade: with more views, what only some show is seen less often."""

    steps: int
    opacity_decay: float


FEW = StepDefaults(900, 0.9925)  # of a fit to so few training views
MANY = StepDefaults(1100, 0.995)  # of a fit to more, where nothing tells how many of them show each patch
FADING_STEPS = 1000  # up to so many the defaults of few views are used: in longer fits too much would fade


@dataclass(frozen=True)
class Plan:
    """What is settled before a fit begins; :func:`make_plan` makes it.

    Args:
        config: the settings, with numbers for the scene where they were left open. A `sh_degree` of None counts as 0, a
            `drop` of None as 0.3, a `steps` of None as 1100; :func:`kgs.fit.run.decide` replaces them.
        device: of the fit.
        backend: "numba", "triton" or "torch".
        schedule: the steps at which things happen.
        decisions: what was decided about the scene, and why.
    """

    config: FitConfig
    device: torch.device
    backend: str
    schedule: Schedule
    decisions: Decisions = field(default_factory=Decisions)

    def decided(self, entries: dict[str, Any], **decisions: Any) -> Self:
        """The plan with these entries of its configuration; `decisions` say by name why, see :class:`Decisions`."""
        config = replace(self.config, **entries)
        made = replace(self.decisions, **decisions)
        return replace(self, config=config, schedule=make_schedule(config), decisions=made)


def make_plan(scene: Scene, config: FitConfig) -> Plan:
    """Settle what the configuration leaves open, but for what :func:`kgs.fit.run.decide` decides.

    Args:
        scene: the scene to fit.
        config: the settings as they were asked for.

    Raises:
        TypeError: an argument is of another type.
        ValueError: the device cannot be used, or the backend does not run on it.
        ModuleNotFoundError: the backend is numba or triton, and it is not installed.
    """
    check_kind("scene", scene, Scene)
    check_kind("config", config, FitConfig)
    device = check_device(config.device)
    backend = resolve(config.backend, device)
    config = with_step_defaults(config, len(scene.train))
    return Plan(config, device, backend, make_schedule(config))


def with_step_defaults(config: FitConfig, views: int) -> FitConfig:
    """The configuration with the numbers for so many training views, where it leaves them open.

    The number of steps stays open for more than three views: how many of them show each patch decides.
    """
    few = views <= FEW_VIEWS
    steps = config.steps or (FEW.steps if few else None)
    recipe = config.recipe
    if recipe.opacity_decay is None:
        defaults = FEW if few and steps is not None and steps <= FADING_STEPS else MANY
        recipe = replace(recipe, opacity_decay=defaults.opacity_decay)
    return replace(config, steps=steps, coarse=config.coarse or 0.0, recipe=recipe)


def make_schedule(config: FitConfig) -> Schedule:
    """Scale the recipe's counts by steps / `recipe.steps`.

    A short fit shortens the densification interval only as far as it needs to densify about 20 times, and never below
    10 steps: with mean gradients over few steps the number of Gaussians explodes. `reset_recovery` skips resets. Looks
    for haze are at least 50 steps apart: before that a fit is too rough to tell a veil from what is not fitted yet.
    A `steps` of None counts as that of a fit to more than three views.
    """
    recipe = config.recipe
    steps = config.steps or MANY.steps
    scale = steps / recipe.steps
    interval = max(10, round(min(recipe.densify_interval, steps / 20) * max(1.0, scale)))
    spacing = max(1, round(recipe.reset_interval * scale)) if recipe.reset_interval else steps
    resets = [*range(spacing, steps, spacing), steps]
    looks = max(50, round(recipe.haze_interval * scale)) if recipe.haze_interval else steps
    evaluations = range(1, config.evaluations + 1)
    return Schedule(
        steps=steps,
        sh=tuple(max(1, round(recipe.sh_interval * scale * k)) for k in range(1, (config.sh_degree or 0) + 1)),
        densify=tuple(s for s in range(interval, steps, interval) if s > round(recipe.densify_from * scale)),
        reset=tuple(s for s, following in pairwise(resets) if following - s >= recipe.reset_recovery),
        haze=tuple(range(looks, round(0.9 * steps) + 1, looks)),
        evaluate=tuple(sorted({max(1, round(steps * k / config.evaluations)) for k in evaluations})),
        drop=steps - min(config.no_drop_steps, round(0.1 * steps)),
        coarse=round((config.coarse or 0.0) * steps),
    )


def gaussian_limit(config: FitConfig, points: int) -> int:
    """The number of Gaussians at which densification stops, in a fit from `points` initial points."""
    return config.max_gaussians or max(10 * (config.steps or MANY.steps), 3 * points // 2)


# Bytes, fitted to measured runs: of the program, for each Gaussian, for each pixel of all training views.
_MEMORY = (930 * 2.0**20, 1000.0, 115.0)


def expected_memory(scene: Scene, gaussians: int) -> float:
    """Bytes of the process at the peak of a fit with so many Gaussians."""
    of_program, of_gaussian, of_pixel = _MEMORY
    return of_program + of_gaussian * gaussians + of_pixel * scene.train.images[:, 0].numel()
