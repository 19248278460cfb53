"""Dropping: left out where many photos show each place, used otherwise, and never decided where a rate is given."""

import json
from dataclasses import replace

import pytest
import torch

from kgs.datasets import synthetic_scene
from kgs.drop import DropGaussian
from kgs.fit.config import DROP, FitConfig
from kgs.fit.dropping import MOST_PHOTOS, decide_drop
from kgs.fit.plan import make_plan
from kgs.fit.prune import left_out
from kgs.fit.run import fit_scene
from kgs.fit.trainer import Trainer
from kgs.init_points import InitialPoints
from kgs.init_points.patches import MIN_PATCHES, PatchColors

CONFIG = FitConfig(steps=4, evaluations=1)


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene("room", train_views=8, test_views=1, size=(24, 32))


def points_seen_by(photos: float, views: int = 8, count: int = 1000):
    """Points whose patches are shown by so many photos in the mean."""
    shown = torch.full((count, 1), int(photos))
    shown[: round((photos - int(photos)) * count)] += 1
    visible = torch.arange(views) < shown
    patches = PatchColors(torch.zeros(count, views, 3), visible, torch.zeros(count, views, 3))
    cloud = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([-0.5, -0.5, 2.0])
    return InitialPoints(cloud, torch.full((50, 3), 0.5), "dense", patches)


@pytest.mark.parametrize(("photos", "rate"), [(3.0, DROP), (MOST_PHOTOS - 0.1, DROP), (MOST_PHOTOS + 0.1, 0.0)])
def test_dropping_is_left_out_where_many_photos_show_a_place(scene, photos, rate):
    plan = decide_drop(make_plan(scene, CONFIG), points_seen_by(photos))
    assert plan.config == replace(make_plan(scene, CONFIG).config, drop=rate)
    assert json.loads(json.dumps(plan.needs)) == {"drop": {"chosen": rate, "photos": pytest.approx(photos), "n": 1000}}
    assert ("dropping" in left_out(plan.needs)) == (rate == 0)
    assert (Trainer(scene, plan, points_seen_by(photos)).state.drop is None) == (rate == 0)


@pytest.mark.parametrize(
    "points", [points_seen_by(8.0, count=MIN_PATCHES - 1), replace(points_seen_by(8.0), patches=None)]
)
def test_without_patches_gaussians_are_dropped(scene, points):
    plan = decide_drop(make_plan(scene, CONFIG), points)
    assert (plan.config.drop, plan.needs) == (DROP, {})


@pytest.mark.parametrize("rate", [0.0, 0.2])
def test_a_given_rate_is_not_decided(scene, rate):
    plan = make_plan(scene, replace(CONFIG, drop=rate))
    assert decide_drop(plan, points_seen_by(8.0)) is plan


def test_a_trainer_whose_rate_is_open_drops(scene):
    drop = Trainer(scene, make_plan(scene, CONFIG), points_seen_by(3.0)).state.drop
    assert isinstance(drop, DropGaussian)
    assert drop.p == DROP


def test_a_fit_goes_on_with_the_rate_that_was_decided(scene, tmp_path):
    plan = decide_drop(make_plan(scene, CONFIG), points_seen_by(8.0))
    trainer = Trainer(scene, plan, points_seen_by(8.0))
    trainer.train_step()
    trainer.save(tmp_path / "c.safetensors")
    resumed = Trainer.resume(scene, CONFIG, tmp_path / "c.safetensors")
    assert resumed.state.drop is None
    assert resumed.plan.needs == plan.needs
    assert resumed.plan.config.drop == 0


def test_a_whole_fit_says_what_it_decided():
    """Eight photos of the room, all of which show most places."""
    large = synthetic_scene("room", train_views=8, test_views=1, size=(96, 128))
    fit = fit_scene(large, CONFIG)
    found = fit.history["needs"]["drop"]
    assert found["chosen"] == fit.settings.drop == (0.0 if found["photos"] > MOST_PHOTOS else DROP)
    assert 3 <= found["photos"] <= 8
