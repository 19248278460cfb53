"""What a scene needs, and no more: chosen before the fit by short ones with a training view left out, where they can.

A probe is a fit in small: a training view is left out, the pictures have half their width, first points are made anew
without the view, and rates of learning are `HASTE` times higher, so that few steps go far. Probes of one left-out view
differ in a single choice: the difference of their PSNR in that view is its gain. The dearer choice is taken where its
mean gain is above `LEAST` decibels and `CERTAIN` standard errors over the left-out views; else the cheaper one. With
fewer than `FEWEST` training views none can be spared, and in small pictures little is to be seen: then the cheaper
choice stands, and "by" says "rule".
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
from kgs.init_points import FirstPoints
from kgs.io.console import Stage, silent
from kgs.metrics.evaluate import BEST

from .config import CHOICES, FitConfig, Recipe
from .trainer import Trainer

FEWEST, MOST = 4, 12  # training views: of how many one can be left out; how many others a probe has
FOLDS = 2  # views that are left out, one at a time
SHARE = 0.25  # of the fit's steps in all probes together
LEAST, CERTAIN = 0.1, 2.0
HASTE = 4.0
SMALLEST, FEWEST_STEPS = 24, 10  # pixels of a side, halved; steps of a probe
Choose = Callable[[Scene, FitConfig], FirstPoints]


def decide(
    scene: Scene, config: FitConfig, choose: Choose, stage: Stage = silent
) -> tuple[FitConfig, dict[str, dict[str, Any]]]:
    """The configuration with nothing left open, and what was decided for each entry that was.

    Args:
        scene: posed views; the test views are not looked at.
        config: entries that are None are decided.
        choose: makes first points of a scene, :func:`kgs.fit.run.choose_points`.
        stage: shows how far the probes are.

    Returns:
        The configuration, and for each open entry a dict of "chosen", "by" ("rule" or "probes"), for a rule "why", and
        for probes "over" (the value that it was compared with), "gain" (of the dearer choice, in dB), "noise" (the
        standard error of the gain) and "n" (left-out views).
    """
    still_open = [name for name in CHOICES if getattr(config, name) is None]
    settled = replace(config, **{name: CHOICES[name].cheaper for name in still_open})
    views, fits = scene.train, 1 + len(still_open)
    steps = math.floor(SHARE * config.steps / (FOLDS * fits))
    reasons = {
        "too few views to leave one out": len(views) < FEWEST,
        "too small pictures for probes": min(views.images.shape[-2:]) < 2 * SMALLEST,
        "too few steps for probes": steps < FEWEST_STEPS,
    }
    if not still_open or any(reasons.values()):
        why = {"by": "rule", "why": next((reason for reason, holds in reasons.items() if holds), "")}
        return settled, {name: {"chosen": CHOICES[name].cheaper, **why} for name in still_open}
    needs, cheap = dict[str, Any](), _hasty(settled, steps)

    @lru_cache(maxsize=1)  # the fits of one left-out view follow each other
    def start(fold: int) -> tuple[Scene, FirstPoints]:
        small = _without(scene, fold)
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            return small, choose(small, cheap)

    variants = [settled, *(replace(settled, **{name: CHOICES[name].dearer}) for name in still_open)]
    left_out = [round((fold + 0.5) * len(views) / FOLDS - 0.5) for fold in range(FOLDS)]
    levels: dict[int, list[float]] = {fold: [] for fold in left_out}
    for fold, variant in stage([(f, v) for f in left_out for v in variants], "probes", "fit"):
        small, points = start(fold)
        trainer = Trainer(small, _hasty(variant, steps), points)
        trainer.fit()
        levels[fold].append(trainer.psnr(small.test) or BEST)
    for place, name in enumerate(still_open, 1):
        gains = [row[place] - row[0] for row in levels.values()]
        gain, noise = fmean(gains), stdev(gains) / math.sqrt(len(gains))
        cheaper, dearer = CHOICES[name]
        chosen = dearer if gain > max(LEAST, CERTAIN * noise) else cheaper
        needs[name] = {"chosen": chosen, "by": "probes", "over": cheaper if chosen == dearer else dearer}
        needs[name] |= {"gain": round(gain, 3), "noise": round(noise, 3), "n": len(gains)}
        settled = replace(settled, **{name: chosen})
    return settled, needs


def _without(scene: Scene, view: int) -> Scene:
    """The scene at half its width, with a training view in the place of the test views, and at most `MOST` others."""
    rest = [i for i in range(len(scene.train)) if i != view]
    rest = [rest[i] for i in select_evenly(len(rest), min(len(rest), MOST))]
    finer = None if scene.finer is None else scene.finer.select(rest).halved()
    train, test = (scene.train.select(some).halved() for some in (rest, [view]))
    return replace(scene, train=train, test=test, finer=finer)


def _hasty(config: FitConfig, steps: int) -> FitConfig:
    """The same fit in few steps, each of which goes far."""
    recipe = config.recipe
    rates = {name: HASTE * getattr(recipe, name) for name in Recipe.__annotations__ if name.startswith("lr_")}
    recipe = replace(recipe, opacity_decay=recipe.opacity_decay**HASTE, **rates)
    return replace(config, steps=steps, evaluations=1, refine_poses=False, recipe=recipe)
