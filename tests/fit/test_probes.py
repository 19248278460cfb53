"""What a fit decides of its scene: by a rule, by probes, and what of its result it leaves out."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from factories import random_model
from kornia.geometry.camera import PinholeCamera

from kgs import GaussianModel
from kgs.datasets import synthetic_scene
from kgs.fit import Fit, FitConfig, probes
from kgs.fit.plan import make_plan, with_pace
from kgs.fit.probes import decide
from kgs.fit.prune import QUANTUM, TOLERANCE, contributions, left_out, prune
from kgs.fit.run import choose_points
from kgs.reference import render
from kgs.types import RasterOptions

OPEN = FitConfig(steps=400, init="random", init_points=300)


@pytest.fixture(scope="module")
def eight():
    return synthetic_scene(train_views=8, test_views=2, size=(48, 64), seed=1)


class Probes:
    """Stands for the trainer: notes what it is asked for, and its fits have the given levels, one after the other."""

    def __init__(self, levels):
        self.levels = levels
        self.seen = []

    def __call__(self, scene, plan, points):
        self.seen.append((scene, plan.config))
        return self

    def fit(self):
        return self

    def psnr(self, views):
        return self.levels[len(self.seen) - 1]


def decided(scene, config=OPEN, choose=None):
    """The configuration, and what is said of it."""
    plan = decide(scene, make_plan(scene, config), choose)
    assert plan.times == make_plan(scene, plan.config).times
    return plan.config, plan.needs


@pytest.mark.parametrize("views", [1, 3])
def test_too_few_views_to_leave_one_out_follow_the_rule(views):
    scene = synthetic_scene(train_views=views, size=(48, 64))
    config, found = decided(scene)
    by_rule = {"chosen": 0, "by": "rule", "why": "too few views to leave one out"}
    assert (config, found) == (with_pace(replace(OPEN, sh_degree=0), views), {"sh_degree": by_rule})


def test_without_steps_or_in_small_pictures_the_rule_decides(eight):
    small = replace(eight, train=eight.train.halved())
    for scene, config, why in ((eight, replace(OPEN, steps=20), "steps"), (small, OPEN, "small images")):
        found = decided(scene, config)[1]["sh_degree"]
        assert (found["chosen"], found["by"]) == (0, "rule")
        assert why in found["why"]


def test_what_is_given_is_not_decided(eight):
    plan = make_plan(eight, replace(OPEN, sh_degree=2))
    assert decide(eight, plan, None) == plan


@pytest.mark.parametrize(
    ("levels", "chosen", "gain", "noise"),
    [
        ((20.0, 20.5, 24.0, 24.6), 3, 0.55, 0.05),  # more than its noise
        ((20.0, 21.5, 24.0, 23.9), 0, 0.7, 0.8),  # not to be told from noise
        ((20.0, 20.05, 24.0, 24.05), 0, 0.05, 0.0),  # too little
        ((20.0, 19.0, 24.0, 23.0), 0, -1.0, 0.0),
        ((None, None, 20.0, 19.0), 0, -0.5, 0.5),  # renders that equal the photo
    ],
)
def test_the_dearer_choice_has_to_gain_more_than_noise(monkeypatch, eight, levels, chosen, gain, noise):
    monkeypatch.setattr(probes, "Trainer", Probes(levels))
    config, found = decided(eight, OPEN, choose_points)
    assert config == with_pace(replace(OPEN, sh_degree=chosen), 8)
    assert found["sh_degree"]["gain"] == pytest.approx(gain, abs=1e-3)
    assert found["sh_degree"]["noise"] == pytest.approx(noise, abs=1e-3)
    assert (found["sh_degree"]["chosen"], found["sh_degree"]["over"]) == (chosen, 3 - chosen)
    assert json.loads(json.dumps(found)) == found


def test_a_probe_knows_nothing_of_the_view_that_is_left_out(monkeypatch, eight):
    stand_in = Probes([20.0] * 4)
    asked = []
    monkeypatch.setattr(probes, "Trainer", stand_in)

    def choose(scene, config):
        asked.append(scene.train.names)
        return choose_points(scene, config)

    decided(eight, OPEN, choose)
    assert sum(config.steps for _, config in stand_in.seen) <= OPEN.steps / 4
    assert len(asked) == 2  # initial points of each left-out view, for both fits
    left_out = set()
    for scene, config in stand_in.seen:
        (name,) = scene.test.names
        left_out.add(name)
        assert name in eight.train.names
        assert name not in scene.train.names
        assert scene.finer is None or name not in scene.finer.names
        assert scene.train.images.shape[-2:] == (24, 32)
        assert config.sh_degree in (0, 3)
    assert len(left_out) == 2
    assert all(left_out.isdisjoint(names) or len(left_out & set(names)) == 1 for names in asked)


@pytest.mark.slow
def test_probes_of_many_views_have_a_dozen_of_them(monkeypatch):
    stand_in = Probes([20.0] * 4)
    monkeypatch.setattr(probes, "Trainer", stand_in)
    decided(synthetic_scene(train_views=30, size=(48, 64)), OPEN, choose_points)
    assert {len(scene.train) for scene, _ in stand_in.seen} == {probes.MAX_VIEWS}


@pytest.mark.slow
def test_the_same_seed_decides_the_same(eight):
    first = decided(eight, OPEN, choose_points)
    assert decided(eight, OPEN, choose_points) == first
    assert first[1]["sh_degree"]["by"] == "probes"
    assert math.isfinite(first[1]["sh_degree"]["gain"])


# -- what is left out of the result ---------------------------------------------------------------------------------


def as_fit(scene, model, **changes):
    """A fit whose Gaussians are these."""
    config = FitConfig(steps=5, sh_degree=model.max_sh_degree, **changes)
    return Fit(scene, model, RasterOptions(near_plane=0.01), settings=config, history={"needs": {"other": 1}})


def in_front(scene, n, sh_degree=0):
    """A model of n Gaussians, the last two of them behind the cameras and hidden."""
    camera = scene.train.camera(0)
    model = random_model(n, sh_degree)
    to_world = torch.linalg.inv(camera.extrinsics[0])
    local = torch.cat([0.8 * torch.rand(n, 2) - 0.4, 3 + torch.rand(n, 1)], 1)
    local[-1, 2] = -5.0
    with torch.no_grad():
        model.means.copy_(local @ to_world[:3, :3].T + to_world[:3, 3])
        model.log_scales.fill_(math.log(0.1))
        model.opacity_logits.fill_(0.0)
    return model


def test_contributions_are_sums_of_blending_weights(each_backend, scene):
    model = in_front(scene, 9)
    total = torch.zeros(9, dtype=torch.float64)
    gaussians = model().to(torch.float64)
    one_each = replace(gaussians, colors=torch.eye(9, dtype=torch.float64))
    for i in range(len(scene.train)):
        camera = scene.train.camera(i)
        double = PinholeCamera(camera.intrinsics.double(), camera.extrinsics.double(), camera.height, camera.width)
        total += render(one_each, double, near_plane=0.01).sum((0, 2, 3)).detach()
    assert float(total[:-1].max()) > 1.0
    found = contributions(model, scene.train, near_plane=0.01).double()
    np.testing.assert_allclose(found, total, atol=1e-4 * float(total.max()))


def test_what_no_view_shows_is_left_out_and_the_pictures_stay(each_backend, scene):
    fit = as_fit(scene, in_front(scene, 40))
    pruned = prune(fit)
    found = pruned.history["needs"]["gaussians"]
    assert found["fitted"] == 40 == len(fit.model)
    assert found["kept"] == len(pruned.model) < 40
    assert not bool((pruned.model.means == fit.model.means[-1]).all(1).any())
    for i in range(3):
        view = scene.train.select([i])
        camera = scene.train.camera(i)
        assert abs(pruned.psnr(view) - fit.psnr(view)) <= TOLERANCE
        assert float((pruned.render(camera) - fit.render(camera)).abs().mean()) < 0.01


def test_pruning_changes_no_other_fit_and_can_be_repeated_from_its_part(scene):
    fit = as_fit(scene, in_front(scene, 40))
    pruned = prune(fit)
    assert (len(fit.model), fit.part, fit.history["needs"]) == (40, {}, {"other": 1})
    assert pruned.history["needs"]["other"] == 1
    assert torch.equal(fit.model.select(**pruned.part).means, pruned.model.means)


def test_keep_all_keeps_all(scene):
    fit = as_fit(scene, in_front(scene, 10), keep_all=True)
    assert prune(fit) is fit


@pytest.mark.parametrize(("size", "degree"), [(1e-5, 0), (1.0, 2)])
def test_harmonics_that_no_picture_shows_are_left_out(scene, size, degree):
    model = in_front(scene, 12, 3)
    with torch.no_grad():
        model.sh_rest *= size / model.sh_rest.abs().max()
        model.sh_rest[:, 8:] = 0.0
    fit = as_fit(scene, model)
    pruned = prune(fit)
    assert pruned.model.max_sh_degree == pruned.history["needs"]["gaussians"]["sh_degree"] == degree
    camera = scene.train.camera(0)
    assert float((pruned.render(camera) - fit.render(camera)).abs().max()) <= QUANTUM + 0.02


def test_harmonics_without_which_a_view_is_worse_stay(scene):
    """They change no 8-bit value by more than half a step, but here the photos are the renders themselves."""
    model = in_front(scene, 12, 1)
    with torch.no_grad():
        model.sh_rest *= 1e-3 / model.sh_rest.abs().max()
    render_of = as_fit(scene, model).render
    renders = torch.cat([render_of(scene.train.camera(i)).clamp(0, 1) for i in range(len(scene.train))])
    noise = 1e-4 * torch.rand(renders.shape, generator=torch.Generator().manual_seed(0))
    pruned = prune(as_fit(replace(scene, train=replace(scene.train, images=renders + noise)), model))
    assert pruned.model.max_sh_degree == 1


def test_select_takes_rows_and_bands():
    model = random_model(7, 3)
    part = model.select(torch.tensor([True, False] * 3 + [True]), 1)
    assert isinstance(part, GaussianModel)
    assert (len(part), part.max_sh_degree, part.sh_degree) == (4, 1, 1)
    assert torch.equal(part.sh_rest, model.sh_rest[::2, :3])
    assert torch.equal(part.means, model.means[::2])
    with pytest.raises(ValueError, match="sh_degree"):
        part.select(torch.ones(4, dtype=torch.bool), 2)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ({}, ""),
        ({"sh_degree": {"chosen": 3, "by": "probes", "gain": 0.4, "noise": 0.1, "n": 2}}, ""),
        ({"sh_degree": {"chosen": 0, "by": "rule", "why": "no time for probes"}}, "harmonics (no time for probes)"),
        (
            {
                "sh_degree": {"chosen": 0, "by": "probes", "gain": -0.1, "noise": 0.2, "n": 2},
                "gaussians": {"fitted": 200, "kept": 114},
            },
            "harmonics (-0.10 dB in 2 probes, noise 0.20), "
            "43 % of the Gaussians (next to no contribution to a training view)",
        ),
    ],
)
def test_what_was_left_out_in_words(found, words):
    assert left_out(found) == words
