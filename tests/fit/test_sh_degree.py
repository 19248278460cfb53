"""Whether colours depend on the direction: decided from patches of surface, or by a rule."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from yard import yard_depths

from kgs.fit import FitConfig, InitialPoints, sh_degree
from kgs.fit.plan import make_plan
from kgs.fit.run import choose_points
from kgs.fit.sh_degree import MIN_GAIN, harmonics_kernel, possible_gain, without_exposure
from kgs.geometry.cameras import to
from kgs.geometry.harmonics import harmonics_basis
from kgs.geometry.multiview import unproject
from kgs.geometry.rigs import camera_centers
from kgs.init_points.patches import MIN_PATCHES, PatchColors

VIEWS = 8
OPEN = FitConfig(steps=400, drop=0.3)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def made_up(patches=1200, views=VIEWS, size=0.0, noise=0.0, exposure=0.0, spread=1.0, outliers=0.0, seed=0):
    """Patches whose colours have harmonics of this standard deviation, seen by cameras on a cap around them.

    Each view shows seven of ten patches; its colours have noise, outliers, and an exposure of their own.
    """
    rng = generator(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=rng)

    centers = torch.nn.functional.normalize(spread * normal(views, 3) + torch.tensor([0.0, 0.0, -1.0]), dim=1)
    points = 0.2 * normal(patches, 1, 3)
    directions = torch.nn.functional.normalize(points - centers, dim=-1)
    basis = harmonics_basis(directions.reshape(-1, 3), 3)[:, 1:].reshape(patches, views, 15)
    coefficients = size * math.sqrt(4 * math.pi / 15) * normal(patches, 15, 3)
    colors = 0.2 + 0.6 * torch.rand(patches, 1, 3, generator=rng) + basis @ coefficients
    colors = colors * (1 + exposure * normal(views, 1)) + 0.3 * exposure * normal(views, 3)
    colors = colors + noise * normal(patches, views, 3)
    wrong = torch.rand(patches, views, 1, generator=rng) < outliers
    colors = torch.where(wrong, torch.rand(patches, views, 3, generator=rng), colors)
    visible = torch.rand(patches, views, generator=rng) < 0.7
    wanted = visible.sum(1) >= 3
    return PatchColors(colors[wanted], visible[wanted], directions[wanted])


@pytest.mark.parametrize("noise", [0.002, 0.02, 0.08])
@pytest.mark.parametrize("exposure", [0.0, 0.2])
@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_noise_exposures_and_outliers_are_no_sh_degree(noise, exposure, outliers):
    assert possible_gain(made_up(noise=noise, exposure=exposure, outliers=outliers)) < 0.25 * MIN_GAIN


@pytest.mark.parametrize("noise", [0.002, 0.02])
@pytest.mark.parametrize("exposure", [0.0, 0.2])
@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_harmonics_are_sh_degree(noise, exposure, outliers):
    assert possible_gain(made_up(size=0.05, noise=noise, exposure=exposure, outliers=outliers)) > MIN_GAIN


def test_small_harmonics_gain_little():
    gains = [possible_gain(made_up(size=size, noise=0.01)) for size in (0.0, 0.01, 0.03, 0.1)]
    assert gains == sorted(gains)
    assert gains[1] < MIN_GAIN < gains[3]


def test_the_kernel_is_the_covariance_of_harmonics():
    """The addition theorem, against the basis functions themselves."""
    directions = torch.nn.functional.normalize(torch.randn(3, 5, 3, generator=generator(), dtype=torch.float64), dim=-1)
    basis = harmonics_basis(directions.reshape(-1, 3), 3)[:, 1:].reshape(3, 5, 15)
    expected = basis @ basis.mT * 4 * math.pi / 15
    torch.testing.assert_close(harmonics_kernel(directions), expected, atol=1e-6, rtol=0)


def test_errors_are_those_of_leaving_each_view_out():
    patches = made_up(6, noise=0.1)
    kernel = harmonics_kernel(patches.directions)
    found = iter(sh_degree._errors(patches.colors, patches.visible, kernel).numpy())
    for colors, visible, covariance in zip(
        *(x.double().numpy() for x in (patches.colors, patches.visible, kernel)), strict=True
    ):
        rows = np.flatnonzero(visible)
        for row in rows:
            others = rows[rows != row]
            prior = covariance + sh_degree.FLAT_PRIOR
            weights = np.linalg.solve(prior[np.ix_(others, others)] + np.eye(len(others)), prior[others, row])
            np.testing.assert_allclose(next(found), colors[row] - weights @ colors[others], atol=1e-6)
    assert next(found, None) is None


def test_exposures_are_removed():
    plain = made_up(noise=0.0)
    exposed = made_up(noise=0.0, exposure=0.2)
    colors = without_exposure(exposed.colors, exposed.visible)
    for left, before in ((colors, exposed.colors), (without_exposure(plain.colors, plain.visible), plain.colors)):
        means = (left * plain.visible[..., None]).sum(1, keepdim=True) / plain.visible.sum(1)[:, None, None]
        assert float((left - means)[plain.visible].square().mean().sqrt()) < 2e-3
        assert float(left[plain.visible].std()) > 0.5 * float(before[plain.visible].std())


# -- of a scene -----------------------------------------------------------------------------------------------------


def with_harmonics(scene, depths, size):
    """The scene with harmonics on its surfaces, whose coefficients differ from place to place."""
    views = scene.train
    cameras = to(views.cameras, "cpu", torch.float64)
    images = views.images.clone()
    rng = generator()
    waves = 2.0 * torch.randn(3, 45, generator=rng, dtype=torch.float64)
    phases = 2 * math.pi * torch.rand(45, generator=rng, dtype=torch.float64)
    for view in range(len(views)):
        rows, columns = (depths[view] > 0).nonzero().unbind(1)
        pixels = torch.stack([columns, rows], 1)
        points = unproject(cameras, pixels, depths[view, rows, columns], torch.full_like(rows, view))
        directions = torch.nn.functional.normalize(points - camera_centers(cameras.extrinsics)[view], dim=1)
        coefficients = size * (points @ waves + phases).sin().reshape(-1, 15, 3)
        basis = harmonics_basis(directions, 3)[:, 1:, None]
        images[view, :, rows, columns] += (basis * coefficients).sum(1).T.float()
    return replace(scene, train=replace(views, images=images.clamp(0, 1)))


def decided(scene, config=OPEN):
    """The plan that is decided on, which a second time is the same."""
    points = choose_points(scene, config)
    plan = make_plan(scene, config, points)
    assert make_plan(scene, config, points) == plan
    return plan


def test_surfaces_of_one_colour_need_no_harmonics(arc):
    """In photos with noise, each with its own exposure."""
    exposures = 0.8 + 0.2 * torch.rand(6, 1, 1, 1, generator=generator())
    images = arc.train.images * exposures + 0.02 * torch.randn(arc.train.images.shape, generator=generator())
    plan = decided(replace(arc, train=replace(arc.train, images=images.clamp(0, 1))))
    assert plan.config.sh_degree == 0
    assert plan.decisions.sh_degree.by == "photos"


def test_surfaces_with_harmonics_need_them(arc):
    plan = decided(with_harmonics(arc, yard_depths(arc.train), 0.1))
    assert plan.config.sh_degree == 3
    assert plan.decisions.sh_degree.gain > MIN_GAIN


# -- what is decided ------------------------------------------------------------------------------------------------


def as_points(patches, kind="dense"):
    return InitialPoints(torch.zeros(4, 3), torch.zeros(4, 3), kind, patches)


@pytest.mark.parametrize(("gain", "degree"), [(MIN_GAIN + 0.01, 3), (MIN_GAIN - 0.01, 0), (-1.0, 0)])
def test_harmonics_have_to_gain_enough(monkeypatch, scene, gain, degree):
    monkeypatch.setattr(sh_degree, "possible_gain", lambda _: gain)
    patches = made_up()
    plan = make_plan(scene, OPEN, as_points(patches))
    assert (plan.config.sh_degree, len(plan.schedule.sh)) == (degree, degree)
    found = {"chosen": degree, "by": "photos", "over": 3 - degree, "gain": pytest.approx(gain), "n": len(patches)}
    assert json.loads(json.dumps(plan.decisions.to_dict())) == {"sh_degree": found}


@pytest.mark.parametrize(
    ("points", "why"),
    [
        (as_points(None, "sift"), "sift"),
        (as_points(made_up(views=3, size=0.1)), "too few views"),
        (as_points(made_up(patches=MIN_PATCHES // 2, size=0.1)), "too little surface"),
    ],
)
def test_where_colours_cannot_tell_there_are_no_harmonics(scene, points, why):
    found = make_plan(scene, OPEN, points).decisions.sh_degree
    assert (found.chosen, found.by) == (0, "rule")
    assert why in found.why


def test_what_is_given_is_not_decided(scene):
    plan = make_plan(scene, replace(OPEN, sh_degree=2), as_points(made_up()))
    assert (plan.config.sh_degree, plan.decisions.sh_degree) == (2, None)
