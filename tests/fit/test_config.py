"""Every number of a fit: ranges, kinds, and the steps that follow from them."""

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refused
from trainers import settled

from kgs import ArgumentError, RasterOptions
from kgs.datasets import synthetic_scene
from kgs.fit.config import PAPER, PRESETS, FitConfig, Recipe, Settings
from kgs.fit.decisions import Decisions
from kgs.fit.overlap import FEW, MANY
from kgs.fit.plan import Plan, expected_memory, make_plan, make_schedule


@pytest.mark.parametrize(
    ("steps", "sh", "densify", "reset"),
    [
        (10_000, (1000, 2000, 3000), range(600, 10_000, 100), (3000, 6000, 9000)),  # the release
        (2000, (200, 400, 600), range(200, 2000, 100), (600, 1200)),  # on as much evidence, see make_schedule
    ],
)
def test_a_short_fit_scales_the_counts_of_the_release(steps, sh, densify, reset):
    schedule = make_schedule(settled(PAPER, steps=steps))
    assert (schedule.sh, schedule.densify, schedule.reset) == (sh, tuple(densify), reset)
    assert schedule.evaluate[-1] == steps


@pytest.mark.parametrize("steps", [1, 7, 100, 999])
def test_densification_is_never_closer_than_ten_steps(steps):
    densify = make_schedule(settled(FitConfig(steps=steps))).densify
    assert all(later - step >= 10 for step, later in pairwise(densify))


@pytest.mark.parametrize("steps", [500, 2000, 4000, 10_000, 30_000])
def test_a_reset_leaves_time_to_recover(steps):
    schedule = make_schedule(settled(PAPER, steps=steps))
    assert all(end - step >= 200 for step, end in pairwise([*schedule.reset, steps]))


def test_the_default_leaves_out_resets_and_harmonics():
    schedule = make_schedule(settled(PRESETS["auto"]))
    assert (schedule.sh, schedule.reset) == ((), ())
    assert schedule.densify == make_schedule(settled(PAPER, steps=schedule.steps)).densify


def test_plain_is_paper_without_dropping():
    assert replace(PRESETS["plain"], drop=PAPER.drop) == PRESETS["paper"] == PAPER
    assert PRESETS["plain"].drop == 0


WRONG = {
    "steps": (0, True, 2.0, "3", 10**8, 10**400, np.bool_(True)),
    "drop": (1.0, -0.1, math.nan, "0.2", True),
    "sh_degree": (4, -1),
    "evaluations": (0,),
    "coarse": (1.5, -0.1, math.nan),
    "max_gaussians": (0, -5, True, 1.5),
    "seed": (2**59, 1.5),
    "init": ("points", None, ["dense"], "file"),
    "init_file": ("a.ply", 3, ""),
    "device": (None, 0),
    "recipe": (None, {}),
    "max_bytes": (0,),
}


OF_RECIPE = {"lr_means": 0, "lr_sh_dc": -1, "reset_opacity": 1.0, "adam_eps": math.nan}


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [(FitConfig, name, value) for name, values in WRONG.items() for value in values]
    + [(Recipe, name, value) for name, value in OF_RECIPE.items()],
)
def test_values_out_of_range_or_of_another_kind_are_refused_by_name(kind, name, value):
    with refused(ArgumentError, name="init_file" if value == "file" else name):
        kind(**{name: value})


def test_a_reset_may_not_remove_everything():
    with refused(ArgumentError, name="reset_opacity"):
        Recipe(reset_interval=3000)
    assert Recipe(reset_interval=3000, prune_opacity=0.005).reset_opacity == 0.01


def test_numpys_numbers_and_paths_as_text_become_pythons():
    numbers = {"steps": np.int64(7), "drop": np.float32(0.5), "max_gaussians": np.int32(9)}
    config = FitConfig(**numbers, init="file", init_file="a", recipe=Recipe(dssim_weight=0.3))
    assert [type(x) for x in (config.steps, config.drop, config.max_gaussians)] == [int, float, int]
    assert config.init_file == Path("a")
    assert FitConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(("no_drop", "last"), [(0, 30), (1, 29), (3, 27), (50, 27)])  # a tenth of 30 steps is 3
def test_nothing_is_dropped_in_the_last_steps_but_for_no_more_than_a_tenth(no_drop, last):
    assert make_schedule(settled(FitConfig(steps=30, no_drop_steps=no_drop))).drop == last


def test_the_coarse_share_is_counted_in_steps():
    assert make_schedule(settled(FitConfig(steps=2000))).coarse == 0
    assert make_schedule(settled(FitConfig(steps=1000, coarse=0.5))).coarse == 500


# -- the plan ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("views", "config", "steps", "decay"),
    [
        (1, FitConfig(), FEW.steps, FEW.opacity_decay),
        (3, FitConfig(), FEW.steps, FEW.opacity_decay),
        (4, FitConfig(), MANY.steps, MANY.opacity_decay),
        (3, FitConfig(steps=1001), 1001, MANY.opacity_decay),
        (4, FitConfig(steps=7, recipe=Recipe(opacity_decay=0.5)), 7, 0.5),
    ],
)
def test_a_plan_leaves_nothing_open(points, views, config, steps, decay):
    scene = synthetic_scene(train_views=views, test_views=1, size=(16, 20))
    plan = make_plan(scene, replace(config, seed=3), points)
    expected = {"steps": steps, "drop": 0.3, "sh_degree": 0, "coarse": 0.0, "opacity_decay": decay}
    assert plan.config == Settings.of(replace(config, seed=3), **expected)
    assert plan.schedule == make_schedule(plan.config)
    assert plan.max_gaussians == max(10 * steps, 225)
    assert (plan.device, plan.decisions.overlap, plan.decisions.exposure) == (torch.device("cpu"), None, None)
    assert plan.decisions.sh_degree.by == "rule"
    assert plan.backend in ("numba", "torch")


def test_what_is_given_stays_as_it_is(scene, points):
    given = settled(FitConfig(coarse=0.5, sh_degree=2, max_gaussians=400))
    plan = make_plan(scene, given, points)
    assert (plan.config, plan.max_gaussians, plan.decisions) == (given, 400, Decisions())


@pytest.mark.parametrize("name", ["steps", "drop", "sh_degree", "coarse", "opacity_decay"])
def test_settings_cannot_be_open(name):
    numbers = {"steps": 9, "drop": 0.0, "sh_degree": 0, "coarse": 0.0, "opacity_decay": 1.0}
    with refused(ArgumentError, name=name):
        Settings.of(FitConfig(), **numbers | {name: None})


def test_a_plan_cannot_be_made_of_an_open_configuration(scene, points):
    plan = make_plan(scene, FitConfig(), points)
    with pytest.raises(TypeError, match="^config: expected Settings, got FitConfig"):
        replace(plan, config=FitConfig())
    with pytest.raises(TypeError, match="^config: "):
        Plan(FitConfig(), plan.device, plan.backend, 100, plan.schedule, Decisions())


def test_more_gaussians_or_pixels_take_more_memory(scene):
    smaller = replace(scene, train=scene.train.downsample(2))
    assert expected_memory(scene, 1000) < expected_memory(scene, 10**6)
    assert expected_memory(smaller, 1000) < expected_memory(scene, 1000)


def test_the_memory_of_a_render_is_bounded_as_without_a_fit():
    assert FitConfig().max_bytes == RasterOptions().max_bytes
