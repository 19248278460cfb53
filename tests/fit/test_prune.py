"""What is left out of the result of a fit."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from factories import random_model
from kornia.geometry.camera import PinholeCamera

from kgs import GaussianModel
from kgs.fit import Fit, FitConfig
from kgs.fit.decisions import Decisions, DegreeDecision
from kgs.fit.pruning import QUANTUM, TOLERANCE, contributions, left_out, prune
from kgs.geometry.types import RasterOptions
from kgs.reference import render

OTHERS = Decisions(sh_degree=DegreeDecision(0, "rule"))


def as_fit(scene, model, **changes):
    """A fit whose Gaussians are these."""
    config = FitConfig(steps=5, sh_degree=model.max_sh_degree, **changes)
    return Fit(scene, model, RasterOptions(near_plane=0.01), settings=config, decisions=OTHERS)


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
    found = contributions(model, scene.train, RasterOptions(near_plane=0.01)).double()
    np.testing.assert_allclose(found, total, atol=1e-4 * float(total.max()))


def test_what_no_view_shows_is_left_out_and_the_pictures_stay(each_backend, scene):
    fit = as_fit(scene, in_front(scene, 40))
    pruned = prune(fit)
    found = pruned.decisions.gaussians
    assert found.fitted == 40 == len(fit.model)
    assert found.kept == len(pruned.model) < 40
    assert not bool((pruned.model.means == fit.model.means[-1]).all(1).any())
    for i in range(3):
        view = scene.train.select([i])
        camera = scene.train.camera(i)
        assert abs(pruned.psnr(view) - fit.psnr(view)) <= TOLERANCE
        assert float((pruned.render(camera) - fit.render(camera)).abs().mean()) < 0.01


def test_pruning_changes_no_other_fit_and_can_be_repeated_from_its_part(scene):
    fit = as_fit(scene, in_front(scene, 40))
    pruned = prune(fit)
    assert (len(fit.model), fit.part, fit.decisions) == (40, {}, OTHERS)
    assert pruned.decisions.sh_degree == OTHERS.sh_degree
    assert torch.equal(fit.model.select(**pruned.part).means, pruned.model.means)


def test_without_pruning_all_are_kept(scene):
    fit = as_fit(scene, in_front(scene, 10), prune=False)
    assert prune(fit) is fit


@pytest.mark.parametrize(("size", "degree"), [(1e-5, 0), (1.0, 2)])
def test_harmonics_that_no_picture_shows_are_left_out(scene, size, degree):
    model = in_front(scene, 12, 3)
    with torch.no_grad():
        model.sh_rest *= size / model.sh_rest.abs().max()
        model.sh_rest[:, 8:] = 0.0
    fit = as_fit(scene, model)
    pruned = prune(fit)
    assert pruned.model.max_sh_degree == pruned.decisions.gaussians.sh_degree == degree
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
        ({"sh_degree": {"chosen": 3, "by": "photos", "gain": 0.4, "n": 2000}}, ""),
        (
            {
                "sh_degree": {"chosen": 0, "by": "photos", "gain": 0.02, "n": 2000},
                "gaussians": {"fitted": 200, "kept": 114, "weight": 1.0, "sh_degree": 0},
            },
            "each colour is the same from all directions: harmonics could add at most 0.02 dB; "
            "43 % of the Gaussians are removed: no photo needs them",
        ),
    ],
)
def test_what_was_left_out_in_words(found, words):
    assert left_out(Decisions.from_dict(found)) == words
