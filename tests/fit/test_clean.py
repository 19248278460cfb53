"""Floaters, oversized and elongated Gaussians: planted ones alone are found, and no training view gets worse."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from refusals import refused

from kgs import ArgumentError, GaussianModel, pinhole_cameras
from kgs.datasets.scene import Scene, Views
from kgs.fit import Fit
from kgs.fit.clean import TOLERANCE, check_left, clean, find_artifacts
from kgs.geometry.cameras import posed
from kgs.geometry.types import RasterOptions

SIZE = (30, 40)
SIDE = 40  # Gaussians along a side of the wall


def views_of_a_wall():
    """Three cameras side by side that look along z; their photos are black."""
    k = torch.tensor([[40.0, 0.0, 19.5], [0.0, 40.0, 14.5], [0.0, 0.0, 1.0]])
    extrinsics = torch.eye(4).repeat(3, 1, 1)
    extrinsics[:, 0, 3] = torch.tensor([1.0, 0.0, -1.0])  # the centres are at x = -1, 0 and 1
    cameras = pinhole_cameras(extrinsics, k.expand(3, 3, 3), width=SIZE[1], height=SIZE[0], pixel_centers="integer")
    return Views(cameras, torch.zeros(3, 3, *SIZE), tuple("abc"))


def wall(*planted):
    """A wall of small flat Gaussians at z = 4, and then those that are planted: (mean, scales, opacity)."""
    steps = torch.linspace(-3.0, 3.0, SIDE)
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    means = torch.stack([x, y, torch.full_like(x, 4.0)], -1).reshape(-1, 3)
    scales = torch.tensor([0.1, 0.1, 0.01]).repeat(len(means), 1)
    opacities = torch.full((len(means),), 0.95)
    if planted:
        rows = [torch.tensor(column) for column in zip(*planted, strict=True)]
        means, scales, opacities = (torch.cat(pair) for pair in zip((means, scales, opacities), rows, strict=True))
    n = len(means)
    colors = 0.3 * torch.rand(n, 1, 3, generator=torch.Generator().manual_seed(0))
    colors[SIDE**2 :] = -1.7  # what is planted is dark
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    return GaussianModel(means, quats, scales.log(), opacities.logit(), colors, torch.zeros(n, 0, 3))


def as_fit(model, photos_of=None):
    """A fit of these Gaussians, whose photos are its renders plus noise; `photos_of` gives the photos instead."""
    views = views_of_a_wall()
    none = torch.zeros(0, 3)
    black = torch.zeros(3)
    scene = Scene(views, views.select([]), none, none, "none", black.double(), black, Path("wall"))
    fit = Fit(scene, model, RasterOptions(near_plane=0.01))
    shown = fit if photos_of is None else replace(fit, model=photos_of)
    renders = torch.cat([shown.render(views.camera(i)) for i in range(3)])
    noise = 0.03 * torch.randn(renders.shape, generator=torch.Generator().manual_seed(1))
    photos = (renders + noise).clamp(0.0, 1.0)
    return replace(fit, scene=replace(scene, train=replace(views, images=photos)))


def artifacts_of(fit, strength=1.0):
    views = fit.scene.train
    depths = [fit.render_with_depth(views.camera(i))[1] for i in range(len(views))]
    return find_artifacts(fit.model, strength, views.cameras, depths)


BEFORE_ONE_CAMERA = ((1.0, 0.0, 1.0), (0.06, 0.06, 0.06), 0.99)
NEAR_A_CAMERA = ((0.0, 0.5, 0.2), (0.02, 0.02, 0.02), 0.5)  # outside of all images
ISOLATED = ((0.0, 0.0, 40.0), (0.1, 0.1, 0.1), 0.5)  # behind the wall
OVERSIZED = ((0.5, 0.0, 4.0), (4.0, 3.0, 0.01), 0.3)
ELONGATED = ((-0.5, 0.0, 4.0), (1.5, 0.02, 0.01), 0.3)


@pytest.mark.parametrize(
    ("planted", "kind"),
    [
        (BEFORE_ONE_CAMERA, "floaters"),
        (NEAR_A_CAMERA, "floaters"),
        (ISOLATED, "floaters"),
        (OVERSIZED, "oversized"),
        (ELONGATED, "elongated"),
    ],
)
def test_what_is_planted_before_a_wall_is_found_and_no_other(planted, kind):
    artifacts = artifacts_of(as_fit(wall(planted)))
    assert artifacts.any.nonzero().tolist() == [[SIDE**2]]
    found = {name: int(getattr(artifacts, name).sum()) for name in ("oversized", "elongated", "floaters")}
    assert found == {"oversized": 0, "elongated": 0, "floaters": 0} | {kind: 1}
    assert artifacts.counts(artifacts.any) == found


def test_of_a_wall_nothing_is_removed():
    fit = as_fit(wall())
    assert not bool(artifacts_of(fit).any.any())
    assert not bool(find_artifacts(fit.model).any.any())
    cleaned = clean(fit)
    assert (len(cleaned.fit.model), cleaned.needed) == (SIDE**2, 0)
    assert cleaned.before == cleaned.after


def test_without_cameras_oversized_elongated_and_the_isolated_are_found():
    model = wall(BEFORE_ONE_CAMERA, ISOLATED, OVERSIZED, ELONGATED)
    artifacts = find_artifacts(model)
    rows = {kind: getattr(artifacts, kind).nonzero()[:, 0].sub(SIDE**2).tolist() for kind in ("oversized", "elongated")}
    assert rows == {"oversized": [2], "elongated": [3]}
    assert 1 in artifacts.floaters.nonzero()[:, 0] - SIDE**2


def test_what_two_cameras_confirm_is_no_floater():
    """A blob in the middle, before the wall: both its neighbours see it at its own depth."""
    blob = ((0.0, 0.0, 2.0), (0.2, 0.2, 0.2), 0.99)
    crowd = [((0.1 * k, 0.05, 2.0), (0.2, 0.2, 0.02), 0.99) for k in range(-3, 4)]
    assert not bool(artifacts_of(as_fit(wall(blob, *crowd))).floaters[SIDE**2 :].any())


def test_a_larger_strength_finds_all_that_a_smaller_one_does():
    model = wall(BEFORE_ONE_CAMERA, ISOLATED, OVERSIZED, ELONGATED, ((0.0, 1.0, 4.0), (0.5, 0.08, 0.01), 0.5))
    counts = []
    before = torch.zeros(len(model), dtype=torch.bool)
    for strength in (0.25, 1.0, 4.0, 25.0):
        found = artifacts_of(as_fit(model), strength).any
        assert bool((found | ~before).all())
        before = found
        counts.append(int(found.sum()))
    assert counts[0] < counts[1] < counts[2]


@pytest.mark.parametrize("strength", [1.0, 8.0])
def test_no_training_view_loses_more_than_the_bound(each_backend, strength):
    """The photos show the floater, so it is needed; the elongated Gaussian behind the wall is not."""
    behind = ((-0.5, 0.0, 4.3), (1.5, 0.02, 0.01), 0.3)
    fit = as_fit(wall(BEFORE_ONE_CAMERA, behind))
    cleaned = clean(fit, strength)
    assert (sum(cleaned.removed.values()), cleaned.needed) == (1, 1)
    assert torch.equal(cleaned.fit.model.means, fit.model.means[:-1])
    views = fit.scene.train
    for i in range(3):
        one = views.select([i])
        assert cleaned.before[i] == fit.psnr(one)
        assert cleaned.after[i] == cleaned.fit.psnr(one) >= fit.psnr(one) - TOLERANCE * strength


def test_a_floater_that_the_photos_do_not_show_is_removed_and_the_view_gets_better():
    fit = as_fit(wall(BEFORE_ONE_CAMERA), photos_of=wall())
    cleaned = clean(fit)
    assert cleaned.removed == {"oversized": 0, "elongated": 0, "floaters": 1}
    assert cleaned.after[2] > cleaned.before[2] + 0.5
    assert len(fit.model) == SIDE**2 + 1


@pytest.mark.parametrize("strength", [0.0, -1.0, math.nan, math.inf, 101.0])
def test_a_wrong_strength_is_refused(strength):
    for call in (lambda: find_artifacts(wall(), strength), lambda: clean(as_fit(wall()), strength)):
        with refused(ArgumentError, name="strength"):
            call()


def test_no_photos_too_few_depths_and_no_gaussian_left_are_refused():
    fit = as_fit(wall())
    without_photos = replace(fit.scene.train, images=fit.scene.train.images.to("meta"))
    for name, call in (
        ("fit", lambda: clean(replace(fit, scene=replace(fit.scene, train=without_photos)))),
        ("depths", lambda: find_artifacts(wall(), 1.0, views_of_a_wall().cameras, [torch.ones(SIZE)])),
        ("strength", lambda: check_left(0)),
    ):
        with refused(ArgumentError, name=name):
            call()


@pytest.mark.parametrize("n", [0, 1, 3, 4])
def test_a_few_gaussians_in_one_place_are_no_artifacts(n):
    model = wall()
    with torch.no_grad():
        model.means.copy_(torch.tensor([0.0, 0.0, 4.0]).expand(SIDE**2, 3))
    assert not bool(find_artifacts(model.select(torch.arange(n))).any.any())


def test_a_camera_that_sees_no_gaussian_decides_nothing(each_backend):
    fit = as_fit(wall(ELONGATED))
    views = fit.scene.train
    turned = views.cameras.extrinsics.clone()
    turned[1] = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ turned[1]
    views = replace(views, cameras=posed(views.cameras, turned))
    cleaned = clean(replace(fit, scene=replace(fit.scene, train=views)), 4.0)
    assert cleaned.before[1] == cleaned.after[1]
