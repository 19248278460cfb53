"""Cross-validation on the training views: short fits find out, before the fit, whether a scene needs harmonics.

A probe is a short fit without one of the training views: its images have half the width, its initial points are made
without that view, and its learning rates are `RATE_FACTOR` times higher. The two probes of a left-out view differ in
the degree of the harmonics, 0 and `DEGREE`; the difference of their PSNR in that view is the gain. Harmonics are chosen
where their mean gain over the left-out views exceeds `MIN_GAIN` decibels and `MIN_ERRORS` standard errors. With few
training views, small images or few steps there are no probes and no harmonics, and "by" is "rule".
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from statistics import fmean, stdev

from kgs.datasets.scene import Scene
from kgs.datasets.splits import select_evenly
from kgs.init_points import InitialPoints
from kgs.metrics.evaluate import comparable
from kgs.progress import Stage, silent

from .config import FitConfig, Recipe
from .plan import Plan, make_plan
from .trainer import Trainer

DEGREE = 3  # of the harmonics that a probe tries
MIN_VIEWS = 4  # training views, of which one can be left out
MAX_VIEWS = 12  # training views of a probe
FOLDS = 2  # views that are left out, one at a time
SHARE = 0.25  # of the fit's steps, for all probes together
MIN_GAIN = 0.1  # dB
MIN_ERRORS = 2.0
RATE_FACTOR = 4.0
MIN_SIDE = 24  # pixels of an image, halved
MIN_STEPS = 10  # of a probe
Choose = Callable[[Scene, FitConfig], InitialPoints]


def decide(scene: Scene, plan: Plan, choose: Choose, stage: Stage = silent) -> Plan:
    """Decide the degree of the harmonics, if the plan leaves it open.

    Args:
        scene: posed views; the test views are not used.
        plan: of the fit.
        choose: makes initial points of a scene, :func:`kgs.fit.choose_points`.
        stage: shows the progress.

    Returns:
        The plan with a degree. Its `needs` have under "sh_degree" a dict: "chosen"; "by", "rule" or "probes"; for a
        rule "why"; for probes "over" (the other degree), "gain" (of harmonics, in dB), "noise" (its standard error) and
        "n" (the number of left-out views).
    """
    if plan.config.sh_degree is not None:
        return plan
    if reason := why_no_probes(scene, plan):
        return plan.with_degree(0, {"chosen": 0, "by": "rule", "why": reason})
    views = len(scene.train)
    left_out = [round((fold + 0.5) * views / FOLDS - 0.5) for fold in range(FOLDS)]
    levels: dict[tuple[int, int], float] = {}
    start: tuple[Scene, InitialPoints] | None = None
    for view, degree in stage([(view, degree) for view in left_out for degree in (0, DEGREE)], "probes", "fit"):
        short = _shortened(replace(plan.config, sh_degree=degree), _steps(plan))
        if degree == 0 or start is None:
            small = _without_view(scene, view)
            with warnings.catch_warnings(action="ignore", category=UserWarning):
                start = small, choose(small, short)
        small, points = start
        fit = Trainer(small, make_plan(small, short), points).fit()
        levels[view, degree] = comparable(fit.psnr(small.test))
    gains = [levels[view, DEGREE] - levels[view, 0] for view in left_out]
    gain = fmean(gains)
    noise = stdev(gains) / math.sqrt(len(gains))
    is_worth_it = gain > max(MIN_GAIN, MIN_ERRORS * noise)
    chosen = DEGREE if is_worth_it else 0
    why = {
        "chosen": chosen,
        "by": "probes",
        "over": DEGREE - chosen,
        "gain": round(gain, 3),
        "noise": round(noise, 3),
        "n": len(gains),
    }
    return plan.with_degree(chosen, why)


def why_no_probes(scene: Scene, plan: Plan) -> str:
    """Why there can be no probes; "" where there can."""
    if len(scene.train) < MIN_VIEWS:
        return "too few views to leave one out"
    if min(scene.train.images.shape[-2:]) < 2 * MIN_SIDE:
        return "too small images for probes"
    if _steps(plan) < MIN_STEPS:
        return "too few steps for probes"
    return ""


def _steps(plan: Plan) -> int:
    """The steps of one probe."""
    return math.floor(SHARE * plan.times.steps / (2 * FOLDS))


def _without_view(scene: Scene, view: int) -> Scene:
    """The scene at half its width, with one training view as its test view, and at most `MAX_VIEWS` of the others."""
    others = [i for i in range(len(scene.train)) if i != view]
    others = [others[i] for i in select_evenly(len(others), min(len(others), MAX_VIEWS))]
    finer = None if scene.finer is None else scene.finer.select(others).halved()
    return replace(
        scene, train=scene.train.select(others).halved(), test=scene.train.select([view]).halved(), finer=finer
    )


def _shortened(config: FitConfig, steps: int) -> FitConfig:
    """The same fit in few steps with higher learning rates."""
    recipe = config.recipe
    rates = {name: RATE_FACTOR * getattr(recipe, name) for name in Recipe.__annotations__ if name.startswith("lr_")}
    decay = None if recipe.opacity_decay is None else recipe.opacity_decay**RATE_FACTOR
    recipe = replace(recipe, opacity_decay=decay, **rates)
    return replace(config, steps=steps, evaluations=1, refine_poses=False, recipe=recipe)
