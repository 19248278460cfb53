"""Cross-validation on the training views: short fits decide, before the fit, which options a scene needs.

A probe is a short fit without one of the training views: its images have half the width, its initial points are made
without that view, and its learning rates are `RATE_FACTOR` times higher. The probes of a left-out view differ in one
option; the difference of their PSNR in that view is its gain. The more expensive value is chosen where its mean gain
over the left-out views exceeds `MIN_GAIN` decibels and `MIN_ERRORS` standard errors, else the cheaper one. With few
training views, small images or few steps there are no probes: the cheaper value is chosen, and "by" is "rule".
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from statistics import fmean, stdev
from typing import Any

from kgs.datasets.scene import Scene
from kgs.datasets.splits import select_evenly
from kgs.init_points import InitialPoints
from kgs.io.console import Stage, silent
from kgs.metrics.evaluate import BEST

from .config import CHOICES, FitConfig, Recipe, timetable, with_pace
from .trainer import Trainer

MIN_VIEWS = 4  # training views, of which one can be left out
MAX_VIEWS = 12  # training views of a probe
FOLDS = 2  # views that are left out, one at a time
SHARE = 0.25  # of the fit's steps, for all probes together
MIN_GAIN, MIN_ERRORS = 0.1, 2.0
RATE_FACTOR = 4.0
MIN_SIDE = 24  # pixels of an image, halved
MIN_STEPS = 10  # of a probe
Choose = Callable[[Scene, FitConfig], InitialPoints]


def decide(
    scene: Scene, config: FitConfig, choose: Choose, stage: Stage = silent
) -> tuple[FitConfig, dict[str, dict[str, Any]]]:
    """Decide the options that the configuration leaves open.

    Args:
        scene: posed views; the test views are not used.
        config: entries that are None are decided.
        choose: makes initial points of a scene, :func:`kgs.fit.run.choose_points`.
        stage: shows the progress.

    Returns:
        The configuration without open entries, and for each entry that was open a dict: "chosen"; "by", "rule" or
        "probes"; for a rule "why"; for probes "over" (the other value), "gain" (of the more expensive value, in dB),
        "noise" (its standard error) and "n" (the number of left-out views).
    """
    config = with_pace(config, len(scene.train))
    still_open = [name for name in CHOICES if getattr(config, name) is None]
    settled = replace(config, **{name: CHOICES[name].cheaper for name in still_open})
    views, fits = scene.train, 1 + len(still_open)
    steps = math.floor(SHARE * timetable(config).steps / (FOLDS * fits))
    why_not = ""
    if len(views) < MIN_VIEWS:
        why_not = "too few views to leave one out"
    elif min(views.images.shape[-2:]) < 2 * MIN_SIDE:
        why_not = "too small images for probes"
    elif steps < MIN_STEPS:
        why_not = "too few steps for probes"
    if why_not or not still_open:
        return settled, {name: {"chosen": CHOICES[name].cheaper, "by": "rule", "why": why_not} for name in still_open}
    needs: dict[str, dict[str, Any]] = {}

    @lru_cache(maxsize=1)  # the fits of one left-out view follow each other
    def start(fold: int) -> tuple[Scene, InitialPoints]:
        small = _without_view(scene, fold)
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            return small, choose(small, _shortened(settled, steps))

    variants = [settled, *(replace(settled, **{name: CHOICES[name].dearer}) for name in still_open)]
    left_out = [round((fold + 0.5) * len(views) / FOLDS - 0.5) for fold in range(FOLDS)]
    levels: dict[int, list[float]] = {fold: [] for fold in left_out}
    for fold, variant in stage([(f, v) for f in left_out for v in variants], "probes", "fit"):
        small, points = start(fold)
        trainer = Trainer(small, _shortened(variant, steps), points)
        trainer.fit()
        levels[fold].append(trainer.psnr(small.test) or BEST)
    for place, name in enumerate(still_open, 1):
        gains = [row[place] - row[0] for row in levels.values()]
        gain = fmean(gains)
        noise = stdev(gains) / math.sqrt(len(gains))
        cheaper, dearer = CHOICES[name]
        is_worth_it = gain > max(MIN_GAIN, MIN_ERRORS * noise)
        chosen, other = (dearer, cheaper) if is_worth_it else (cheaper, dearer)
        needs[name] = {
            "chosen": chosen,
            "by": "probes",
            "over": other,
            "gain": round(gain, 3),
            "noise": round(noise, 3),
            "n": len(gains),
        }
        settled = replace(settled, **{name: chosen})
    return settled, needs


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
