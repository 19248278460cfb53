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
from kgs.fit import FitConfig, InitialPoints, Trainer
from kgs.fit import probes as needs
from kgs.fit.config import with_pace
from kgs.fit.plan import make_plan
from kgs.fit.probes import decide
from kgs.fit.prune import QUANTUM, TOLERANCE, contributions, left_out, prune
from kgs.fit.run import choose_points
from kgs.fit.trainer import Start
from kgs.reference import render

OPEN = FitConfig(steps=400, init="random", init_points=300)


@pytest.fixture(scope="module")
def eight():
    return synthetic_scene(train_views=8, test_views=2, size=(48, 64), seed=1)


class Probes:
    """Stands for the trainer: notes what it is asked for, and has given levels by the view left out and the degree."""

    def __init__(self, levels):
        self.levels, self.seen = levels, []

    def __call__(self, scene, config, points):
        self.seen.append((scene, config, points))
        self.level = self.levels[len(self.seen) - 1]
        return self

    def fit(self):
        pass

    def psnr(self, views):
        return self.level


@pytest.mark.parametrize("views", [1, 3])
def test_too_few_views_to_leave_one_out_follow_the_rule(views):
    scene = synthetic_scene(train_views=views, size=(48, 64))
    config, found = decide(scene, OPEN, None)
    by_rule = {"chosen": 0, "by": "rule", "why": "too few views to leave one out"}
    assert (config, found) == (with_pace(replace(OPEN, sh_degree=0), views), {"sh_degree": by_rule})


def test_without_steps_for_probes_the_rule_decides(eight):
    by_rule = {"chosen": 0, "by": "rule", "why": "too few steps for probes"}
    assert decide(eight, replace(OPEN, steps=20), None)[1] == {"sh_degree": by_rule}


def test_in_small_pictures_the_rule_decides(eight):
    small = replace(eight, train=eight.train.halved())
    assert decide(small, OPEN, None)[1]["sh_degree"]["why"] == "too small images for probes"


def test_what_is_given_is_not_decided(eight):
    config = with_pace(replace(OPEN, sh_degree=2), 8)
    assert decide(eight, config, None) == (config, {})


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
    monkeypatch.setattr(needs, "Trainer", Probes(levels))
    config, found = decide(eight, OPEN, choose_points)
    assert config == with_pace(replace(OPEN, sh_degree=chosen), 8)
    assert found["sh_degree"]["gain"] == pytest.approx(gain, abs=1e-3)
    assert found["sh_degree"]["noise"] == pytest.approx(noise, abs=1e-3)
    assert (found["sh_degree"]["chosen"], found["sh_degree"]["over"]) == (chosen, 3 - chosen)
    assert json.loads(json.dumps(found)) == found


def test_a_probe_knows_nothing_of_the_view_that_is_left_out(monkeypatch, eight):
    probes, asked = Probes([20.0] * 4), []
    monkeypatch.setattr(needs, "Trainer", probes)

    def choose(scene, config):
        asked.append(scene.train.names)
        return choose_points(scene, config)

    decide(eight, OPEN, choose)
    assert sum(config.steps for _, config, _ in probes.seen) <= OPEN.steps / 4
    assert len(asked) == 2  # initial points of each left-out view, for both fits
    left_out = set()
    for scene, config, _ in probes.seen:
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
    probes = Probes([20.0] * 4)
    monkeypatch.setattr(needs, "Trainer", probes)
    decide(synthetic_scene(train_views=30, size=(48, 64)), OPEN, choose_points)
    assert {len(scene.train) for scene, _, _ in probes.seen} == {needs.MAX_VIEWS}


def test_the_same_seed_decides_the_same(eight):
    first, again = (decide(eight, OPEN, choose_points) for _ in range(2))
    assert first == again
    assert first[1]["sh_degree"]["by"] == "probes"
    assert math.isfinite(first[1]["sh_degree"]["gain"])


# -- what is left out of the result ---------------------------------------------------------------------------------


def trained(scene, model, **changes):
    """A trainer whose Gaussians are these."""
    points = InitialPoints(torch.rand(8, 3) + torch.tensor([0.0, 0.0, 2.0]), torch.rand(8, 3), "file")
    config = FitConfig(steps=5, sh_degree=model.max_sh_degree, **changes)
    start = replace(Start.from_points(scene, config, points), model=model, near_plane=0.01)
    return Trainer(scene, make_plan(scene, config), start)


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
    trainer = trained(scene, model)
    total = torch.zeros(9, dtype=torch.float64)
    gaussians = model().to(torch.float64)
    one_each = replace(gaussians, colors=torch.eye(9, dtype=torch.float64))
    for i in range(len(scene.train)):
        camera = scene.train.camera(i)
        double = PinholeCamera(camera.intrinsics.double(), camera.extrinsics.double(), camera.height, camera.width)
        total += render(one_each, double, near_plane=0.01).sum((0, 2, 3)).detach()
    assert float(total[:-1].max()) > 1.0
    np.testing.assert_allclose(
        contributions(trainer.model, trainer.scene.train, trainer.state.start.near_plane).double(),
        total,
        atol=1e-4 * float(total.max()),
    )


def test_what_no_view_shows_is_left_out_and_the_pictures_stay(each_backend, scene):
    trainer = trained(scene, in_front(scene, 40))
    before = [trainer.render(scene.train.camera(i)) for i in range(3)]
    levels = [trainer.psnr(scene.train.select([i])) for i in range(3)]
    prune(trainer)
    found = trainer.plan.needs["gaussians"]
    assert found["fitted"] == 40 == len(trainer.model)
    assert found["kept"] == len(trainer.shown) < 40
    assert not bool((trainer.shown.means == trainer.model.means[-1]).all(1).any())
    for i, level in enumerate(levels):
        assert abs(trainer.psnr(scene.train.select([i])) - level) <= TOLERANCE
        assert float((trainer.render(scene.train.camera(i)) - before[i]).abs().mean()) < 0.01


def test_keep_all_keeps_all(scene):
    trainer = trained(scene, in_front(scene, 10), keep_all=True)
    prune(trainer)
    assert trainer.shown is trainer.model
    assert "gaussians" not in trainer.plan.needs


@pytest.mark.parametrize(("size", "degree"), [(1e-5, 0), (1.0, 2)])
def test_harmonics_that_no_picture_shows_are_left_out(scene, size, degree):
    model = in_front(scene, 12, 3)
    with torch.no_grad():
        model.sh_rest *= size / model.sh_rest.abs().max()
        model.sh_rest[:, 8:] = 0.0
    trainer = trained(scene, model)
    trainer.model.sh_degree = 3
    before = trainer.render(scene.train.camera(0))
    prune(trainer)
    assert trainer.shown.max_sh_degree == trainer.plan.needs["gaussians"]["sh_degree"] == degree
    assert float((trainer.render(scene.train.camera(0)) - before).abs().max()) <= QUANTUM + 0.02


def test_harmonics_without_which_a_view_is_worse_stay(scene):
    """They change no 8-bit value by more than half a step, but here the photos are the renders themselves."""
    model = in_front(scene, 12, 1)
    with torch.no_grad():
        model.sh_rest *= 1e-3 / model.sh_rest.abs().max()
    trainer = trained(scene, model)
    trainer.model.sh_degree = 1
    renders = torch.cat([trainer.render(scene.train.camera(i)).clamp(0, 1) for i in range(len(scene.train))])
    noise = 1e-4 * torch.rand(renders.shape, generator=torch.Generator().manual_seed(0))
    trainer = trained(replace(scene, train=replace(scene.train, images=renders + noise)), model)
    trainer.model.sh_degree = 1
    prune(trainer)
    assert trainer.plan.needs["gaussians"]["sh_degree"] == 1


def test_the_next_step_has_all_gaussians_again(scene):
    trainer = trained(scene, in_front(scene, 40))
    prune(trainer)
    trainer.train_step()
    assert trainer.shown is trainer.model
    assert len(trainer.model) == 40


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
