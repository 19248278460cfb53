"""Steps and dropping follow how many photos show each patch of surface, and are never decided where they are given."""

import json
from dataclasses import replace

import pytest
import torch

from kgs.datasets import synthetic_scene
from kgs.fit.config import DROP, FitConfig
from kgs.fit.overlap import (
    FEW,
    FEW_TOGETHER,
    MANY,
    MANY_TOGETHER,
    MAX_STEPS,
    Overlap,
    drop_rate_for,
    steps_for,
)
from kgs.fit.plan import make_plan
from kgs.fit.pruning import left_out
from kgs.fit.run import fit_scene
from kgs.fit.trainer import Trainer
from kgs.init_points import InitialPoints
from kgs.init_points.patches import MIN_PATCHES, PatchColors

OPEN = FitConfig(evaluations=1)


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(train_views=8, test_views=1, size=(24, 32))


def points_seen_by(photos: float, views: int = 8, count: int = 1000):
    """Points whose patches are shown by so many photos in the mean."""
    shown = torch.full((count, 1), int(photos))
    shown[: round((photos - int(photos)) * count)] += 1
    visible = torch.arange(views) < shown
    patches = PatchColors(torch.zeros(count, views, 3), visible, torch.zeros(count, views, 3))
    cloud = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([-0.5, -0.5, 2.0])
    return InitialPoints(cloud, torch.full((50, 3), 0.5), "dense", patches)


def test_steps_rise_and_the_rate_falls_with_the_photos_that_show_the_same_patches():
    photos = torch.linspace(1.0, 12.0, 111).tolist()
    steps = [steps_for(n) for n in photos]
    rates = [drop_rate_for(n) for n in photos]
    assert steps == sorted(steps)
    assert rates == sorted(rates, reverse=True)
    assert (steps_for(1.0), steps_for(3.0), steps_for(12.0)) == (FEW.steps, FEW.steps, MAX_STEPS)
    assert (drop_rate_for(FEW_TOGETHER), drop_rate_for(MANY_TOGETHER)) == (DROP, 0.0)
    assert 0 < drop_rate_for(0.5 * (FEW_TOGETHER + MANY_TOGETHER)) < DROP


def test_photos_that_show_two_patches_are_counted_over_all_pairs():
    visible = torch.rand(40, 6, generator=torch.Generator().manual_seed(1)) < 0.6
    patches = PatchColors(torch.zeros(40, 6, 3), visible, torch.zeros(40, 6, 3))
    pairs = [int((one & other).sum()) for one in visible for other in visible]
    overlap = Overlap.of(patches)
    assert overlap.views_per_pair == pytest.approx(sum(pairs) / len(pairs))
    assert overlap.views_per_patch == pytest.approx(float(visible.sum(1).double().mean()))


@pytest.mark.parametrize("photos", [3.0, 5.0, 8.0])
def test_what_is_open_is_decided_by_the_patches(scene, photos):
    plan = make_plan(scene, OPEN, points_seen_by(photos))
    together = Overlap.of(points_seen_by(photos).patches).views_per_pair
    chosen = {"steps": steps_for(photos), "drop": drop_rate_for(together)}
    assert {name: getattr(plan.config, name) for name in chosen} == chosen
    assert plan.schedule.steps == chosen["steps"]
    numbers = {"views_per_patch": pytest.approx(photos), "views_per_pair": pytest.approx(together, abs=0.01)}
    assert json.loads(json.dumps(plan.decisions.to_dict()))["overlap"] == {**numbers, "patches": 1000, **chosen}
    assert ("DropGaussian is off" in left_out(plan.decisions)) == (chosen["drop"] == 0)
    assert (Trainer(scene, plan, points_seen_by(photos)).state.drop is None) == (chosen["drop"] == 0)


@pytest.mark.parametrize(
    "points", [points_seen_by(8.0, count=MIN_PATCHES - 1), replace(points_seen_by(8.0), patches=None)]
)
def test_without_patches_gaussians_are_dropped_in_a_fit_of_the_usual_length(scene, points):
    plan = make_plan(scene, OPEN, points)
    assert (plan.config.drop, plan.config.steps, plan.decisions.overlap) == (DROP, MANY.steps, None)


@pytest.mark.parametrize("given", [{"drop": 0.0}, {"drop": 0.2}, {"steps": 7}, {"steps": 7, "drop": 0.2}])
def test_what_is_given_is_not_decided(scene, given):
    plan = make_plan(scene, replace(OPEN, **given), points_seen_by(8.0))
    assert {name: getattr(plan.config, name) for name in given} == given
    assert not given.keys() & plan.decisions.to_dict().get("overlap", {}).keys()


def test_a_whole_fit_says_what_it_decided():
    """Five photos of the room, most of which show most patches: some dropping is left."""
    large = synthetic_scene(train_views=5, test_views=1, size=(72, 96))
    fit = fit_scene(large, FitConfig(steps=4, evaluations=1))
    found = fit.decisions.overlap
    assert 3 <= found.views_per_pair <= found.views_per_patch <= 5
    assert 0 < found.drop == fit.settings.drop == pytest.approx(drop_rate_for(found.views_per_pair), abs=0.01)
    assert found.steps is None
