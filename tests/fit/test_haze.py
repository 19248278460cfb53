"""Haze: what veils a training view fades, what the photos show stays."""

import math
from dataclasses import replace

import pytest
import torch
from trainers import settled

from kgs import GaussianModel
from kgs.datasets import synthetic_scene
from kgs.fit import Fit, FitConfig, fit_scene
from kgs.fit.config import PAPER, Recipe
from kgs.fit.haze import FADE, WINDOW, darkest, veils
from kgs.fit.plan import make_schedule
from kgs.geometry.types import RasterOptions


@pytest.fixture(scope="module")
def scene():
    """Three photos of a wall."""
    room = synthetic_scene(train_views=3, test_views=1, size=(48, 64))
    fit = wall(room)
    photos = torch.cat([fit.render(room.train.camera(i)) for i in range(3)]).detach()
    return replace(room, train=replace(room.train, images=photos))


def wall(scene, *, depth=0.5, gray=0.9, opacity=0.0):
    """A wall of 1600 dark and red Gaussians; a gray one as many times as far away has another opacity than 0."""
    to_world = torch.linalg.inv(scene.train.camera(1).extrinsics[0])
    x, y = torch.meshgrid(torch.linspace(-3, 3, 40), torch.linspace(-3, 3, 40), indexing="xy")
    local = torch.stack([x.flatten(), y.flatten(), torch.full((1600,), 4.0)], 1)
    local = torch.cat([local, torch.tensor([[0.0, 0.0, 4.0 * depth]])])
    colors = torch.tensor([[0.1, 0.1, 0.1], [0.5, 0.1, 0.1]])[torch.arange(1601) % 2]
    colors[-1] = gray
    model = GaussianModel.from_points(local @ to_world[:3, :3].T + to_world[:3, 3], colors)
    with torch.no_grad():
        model.opacity_logits.fill_(3.0)
        model.log_scales[-1] = math.log(0.4)
        model.opacity_logits[-1] = math.log(opacity / (1 - opacity)) if opacity else -math.inf
    return Fit(scene, model, RasterOptions(near_plane=0.01))


@pytest.mark.parametrize(
    ("depth", "gray", "found"),
    [(0.5, 0.9, [1600]), (0.5, 0.1, []), (1.5, 0.9, [])],
    ids=["bright before the wall", "dark before the wall", "behind the wall"],
)
def test_only_what_brightens_dark_pixels_from_before_the_surface_is_a_veil(scene, depth, gray, found):
    assert not veils(wall(scene, depth=depth, gray=gray)).any()
    assert veils(wall(scene, depth=depth, gray=gray, opacity=0.2)).nonzero()[:, 0].tolist() == found


def test_pixels_that_do_not_count_tell_nothing(scene):
    fit = wall(scene, opacity=0.2)
    counts = torch.ones(3, 48, 64, dtype=torch.bool)
    assert veils(replace(fit, scene=replace(scene, train=replace(scene.train, valid_mask=counts)))).any()
    views, rows, columns = hazy_pixels(fit)
    counts[views, rows, columns] = False
    assert not veils(replace(fit, scene=replace(scene, train=replace(scene.train, valid_mask=counts)))).any()


def hazy_pixels(fit):
    """Where a render differs from its photo by so much that it could count as hazy."""
    views = fit.scene.train
    renders = torch.cat([fit.render(views.camera(i)) for i in range(len(views))])
    return ((renders - views.images).abs().amax(1) > 0.005).nonzero().unbind(1)


def test_exposure_does_not_count_as_haze(scene):
    gains = torch.tensor([[1.0, 1.0, 1.0], [1.5, 1.4, 1.3], [0.7, 0.8, 0.9]])
    exposed = replace(scene.train, images=scene.train.images * gains[:, :, None, None], gains=gains)
    assert not veils(wall(replace(scene, train=exposed))).any()
    assert veils(wall(replace(scene, train=exposed), opacity=0.2))[-1]


def test_a_bright_background_is_not_haze(scene):
    fit = wall(replace(scene, background=torch.ones(3)))
    with torch.no_grad():
        fit.model.opacity_logits[:-1] = -0.5
        fit.model.opacity_logits[-1] = -1.0
    assert not veils(fit).any()


def test_the_dark_channel_is_the_least_number_of_a_window():
    image = torch.rand(3, 20, 31, generator=torch.Generator().manual_seed(2))
    half = WINDOW // 2
    for y, x in ((0, 0), (7, 13), (19, 30)):
        window = image[:, max(0, y - half) : y + half + 1, max(0, x - half) : x + half + 1]
        assert float(darkest(image)[y, x]) == pytest.approx(float(window.min()))


def test_a_fit_fades_veils_and_the_papers_recipe_does_not(monkeypatch):
    scene = synthetic_scene(train_views=3, test_views=1, size=(24, 32))
    faded = []
    monkeypatch.setattr("kgs.fit.trainer.veils", lambda fit: torch.arange(len(fit.model)) == 0)
    monkeypatch.setattr(
        "kgs.densify.Densifier.decay_opacity", lambda self, factor, rows=None: faded.append((factor, rows is None))
    )
    config = FitConfig(steps=56, init="random", init_points=50, evaluations=1, recipe=Recipe(opacity_decay=1.0))
    fit_scene(scene, config)
    assert faded == [(FADE, False)]  # after 50 steps
    assert make_schedule(settled(PAPER)).haze == ()


def test_looks_for_haze_end_before_the_fit():
    assert make_schedule(settled(FitConfig(steps=900))).haze == tuple(range(90, 811, 90))
    assert make_schedule(settled(FitConfig(steps=49))).haze == ()
    assert make_schedule(settled(FitConfig(steps=900, recipe=Recipe(haze_interval=0)))).haze == ()
