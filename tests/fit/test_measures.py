"""The content of metrics.json: it says what happened, also where something else was asked for."""

from dataclasses import replace

import pytest
import torch

from kgs.app.page.fit_page import _settings
from kgs.datasets import synthetic_scene
from kgs.fit import Trainer, fit_scene, make_plan, measure
from kgs.fit.config import FitConfig
from kgs.fit.measures import used_init
from kgs.init_points import InitialPoints

CONFIG = FitConfig(steps=1, evaluations=1, max_gaussians=500, init_points=30, prune=False)


@pytest.fixture(scope="module")
def tiny():
    """Photos without texture: there are neither points of depth maps nor keypoints."""
    scene = synthetic_scene(train_views=3, test_views=1, size=(24, 32))
    return replace(scene, train=replace(scene.train, images=torch.full_like(scene.train.images, 0.5)))


@pytest.mark.parametrize("asked", ["dense", "sift", "random"])
def test_the_initial_points_are_those_that_were_used(tiny, asked, recwarn):
    fit = fit_scene(tiny, replace(CONFIG, init=asked))
    assert fit.history["init"] == {"kind": "random", "points": 30}
    metrics = measure(fit)
    words = metrics["protocol"]["init"]
    assert words.startswith("random: initial points from training views alone")
    assert (f"{asked} was asked for" in words) == (asked != "random")
    assert [warning.filename for warning in recwarn] == [__file__] * {"dense": 2, "sift": 1, "random": 0}[asked]
    shown = _settings({"request": {}, "fit": fit.settings.to_dict()}, metrics)
    assert (shown["init"], shown["backend"]) == ("random", fit.backend)
    assert _settings({"fit": {"init": asked, "backend": "auto"}}, {}) == {"init": asked, "backend": "auto"}


def test_points_of_somebody_else_are_not_taken_for_those_of_the_photos(tiny):
    draw = torch.Generator().manual_seed(0)
    points = InitialPoints(torch.rand(30, 3, generator=draw), torch.rand(30, 3, generator=draw), "lidar")
    fit = Trainer(tiny, make_plan(tiny, CONFIG, points), points).fit()
    assert measure(fit)["protocol"]["init"].startswith("lidar: initial points that were given; poses")


def test_random_points_of_a_layout_are_those_of_the_scene():
    assert used_init("scene", "random") == "scene"
    assert used_init("dense", "model-points") == "model-points"
