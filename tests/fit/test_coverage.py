"""PSNR apart for what two training views show and for the rest: against closed forms."""

import math

import pytest
import torch
from factories import pinhole, with_camera
from kornia.metrics import psnr

from kgs.datasets import synthetic_scene
from kgs.fit.config import FitConfig
from kgs.fit.run import fit_scene
from kgs.metrics.coverage import MIN_VIEWS, psnr_by_coverage, views_that_show

HEIGHT, WIDTH, FOCAL, DEPTH = 10, 40, 20.0, 5.0


def rig(*centers):
    """Cameras side by side that look along z; a shift by one unit moves what is at `DEPTH` by four pixels."""
    extrinsics = torch.eye(4).repeat(len(centers), 1, 1)
    extrinsics[:, 0, 3] = -torch.tensor(centers)
    return with_camera(pinhole(HEIGHT, WIDTH, FOCAL, dtype=torch.float32, cameras=len(centers)), extrinsics)


def wall(depth=DEPTH):
    return torch.full((HEIGHT, WIDTH), depth)


def _shown(*given):
    return views_that_show(*given) >= MIN_VIEWS


def test_what_two_pictures_hold_is_shown():
    shown = _shown(wall(), rig(0.0), [wall()] * 2, rig(1.0, 2.0))  # they show what is right of pixels 4 and 8
    assert not bool(shown[:, :8].any())
    assert bool(shown[:, 8:].all())
    assert not bool(_shown(wall(), rig(0.0), [wall()], rig(0.0)).any())  # one view is not enough


def test_what_is_hidden_from_a_view_or_has_no_depth_is_not_shown():
    before = wall()
    before[:, :10] = 2.0  # something near stands before it in one view
    shown = _shown(wall(), rig(0.0), [wall(), before], rig(0.0, 0.0))
    assert not bool(shown[:, :10].any())
    assert bool(shown[:, 10:].all())
    empty = wall()
    empty[2] = 0.0  # without depth
    assert _shown(empty, rig(0.0), [wall()] * 2, rig(0.0, 0.0)).sum() == (HEIGHT - 1) * WIDTH


@pytest.fixture(scope="module")
def fit():
    scene = synthetic_scene(train_views=3, test_views=1, size=(48, 64))
    config = FitConfig(steps=5, sh_degree=0, init="random", init_points=2000, evaluations=1, prune=False)
    return fit_scene(scene, config)


def test_both_parts_together_are_the_whole(fit):
    scene = fit.scene
    found = psnr_by_coverage(
        scene, fit.train_renders.median_depths, fit.test_renders.images, fit.test_renders.median_depths
    )
    assert 0.3 < found["share"] < 1
    errors = [10 ** (-found[name] / 10) for name in ("psnr", "psnr_rest")]
    render = fit.render(scene.test.camera(0)).clamp(0, 1)
    whole = 10 ** (-float(psnr(render, scene.test.images, 1.0)) / 10)
    assert found["share"] * errors[0] + (1 - found["share"]) * errors[1] == pytest.approx(whole, rel=1e-3)
    assert all(math.isfinite(value) for value in found.values())


def test_without_test_views_there_is_nothing_to_say(fit):
    scene = synthetic_scene(train_views=1, test_views=0, size=(8, 8))
    assert psnr_by_coverage(scene, fit.train_renders.median_depths, [], []) is None
