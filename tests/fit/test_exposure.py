"""Exposure: gains that were put on are found; a fit holds them, and photos that do not differ have none."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refused
from trainers import settled

from kgs import ArgumentError, GaussianModel, GaussianRenderer, RasterOptions
from kgs.datasets import synthetic_scene
from kgs.fit import Fit
from kgs.fit.config import PRESETS, FitConfig
from kgs.fit.decisions import Decisions, ExposureDecision
from kgs.fit.exposure import MIN_RATIO, decide_exposure, estimate_gains, with_exposure
from kgs.fit.measures import measure, measure_again
from kgs.fit.plan import make_plan
from kgs.fit.pruning import psnr_per_view
from kgs.fit.run import fit_scene
from kgs.fit.targets import targets
from kgs.init_points import InitialPoints
from kgs.init_points.patches import MIN_PATCHES, PatchColors
from kgs.metrics.evaluate import clipped_psnr, color_corrected, evaluate

GAINS = torch.tensor([[0.5, 0.5, 0.5], [0.8, 0.8, 0.8], [1.25, 1.25, 1.25], [1.1, 1.0, 0.8]])


def patches(gains=GAINS, count=600, noise=0.0, outliers=0.0, seed=0):
    """Colours of random surfaces, each seen by three views or more, times the views' gains."""
    draw = torch.Generator().manual_seed(seed)
    views = len(gains)
    visible = torch.rand(count, views, generator=draw).argsort(1) < torch.randint(
        3, views + 1, (count, 1), generator=draw
    )
    colors = 0.1 + 0.6 * torch.rand(count, 1, 3, generator=draw).expand(-1, views, -1)
    colors = colors * gains * torch.exp(noise * torch.randn(colors.shape, generator=draw))
    wrong = torch.rand(count, views, 1, generator=draw) < outliers
    colors = torch.where(wrong, torch.rand(colors.shape, generator=draw), colors)
    colors = torch.where(visible[..., None], colors, torch.full_like(colors, torch.nan))
    return PatchColors(colors.clamp(0, 1), visible, torch.zeros(count, views, 3))


def centred(gains):
    return gains / gains.log().mean(0).exp()


def points_with(patches):
    return InitialPoints(torch.zeros(4, 3), torch.zeros(4, 3), "dense", patches, torch.zeros(4, dtype=torch.int64))


@pytest.mark.parametrize(("noise", "outliers", "close"), [(0.0, 0.0, 2e-3), (0.05, 0.0, 0.02), (0.05, 0.2, 0.03)])
def test_gains_that_were_put_on_are_found(noise, outliers, close):
    found, left = estimate_gains(patches(noise=noise, outliers=outliers))
    torch.testing.assert_close(found.float(), centred(GAINS), rtol=close, atol=0.0)
    assert left < 0.3


def test_a_view_without_patches_keeps_its_exposure():
    seen = patches(GAINS[[0, 1, 2, 3, 3]])
    hidden = PatchColors(seen.colors, seen.visible & (torch.arange(5) < 4), seen.directions)
    found, _ = estimate_gains(hidden)
    assert bool(found.isfinite().all())
    torch.testing.assert_close((found / found[4])[:4].float(), centred(GAINS[:4]), rtol=0.05, atol=0.0)


@pytest.mark.parametrize(
    ("how", "patches"),
    [
        ("auto", patches(torch.ones(4, 3), noise=0.1)),
        ("auto", patches(count=MIN_PATCHES - 1)),
        ("auto", None),
        ("auto", patches(1 + 0.04 * (GAINS - 1), noise=0.1)),
        ("auto", patches(1 + 0.5 * (GAINS - 1), noise=0.3)),  # gains explain little of this
        ("same", patches()),
    ],
)
def test_photos_that_do_not_differ_or_cannot_tell_have_no_gains(how, patches):
    assert decide_exposure(patches, how) is None


def test_photos_that_differ_or_for_which_they_are_asked_have_gains():
    warm = torch.ones(4, 3)
    warm[0, 0] = 1.1 * MIN_RATIO
    decision = decide_exposure(patches(warm), "auto")
    torch.testing.assert_close(torch.tensor(decision.gains), centred(warm), rtol=5e-3, atol=0.0)
    assert decide_exposure(patches(torch.ones(4, 3)), "each") is not None
    with pytest.warns(UserWarning, match="exposure: "):
        assert decide_exposure(None, "each") is None


@pytest.mark.parametrize("preset", ["paper", "plain"])
def test_the_presets_of_the_paper_have_none(scene, preset):
    assert make_plan(scene, PRESETS[preset], points_with(patches())).decisions.exposure is None


# -- of a scene -----------------------------------------------------------------------------------------------------

CONFIG = FitConfig(steps=70, evaluations=1, sh_degree=0, init_points=6000, max_gaussians=6000)
EXPOSURES = torch.tensor([[0.3, 0.3, 0.3], [0.6, 0.6, 0.6], [1.25, 1.25, 1.25], [1.1, 1.0, 0.6]])[[0, 1, 2, 3, 1, 2]]


@pytest.fixture(scope="module")
def exposed(arc):
    """The same scene in photos of which each has an exposure and a white balance of its own, one of them saturated."""
    images = (arc.train.images * EXPOSURES[:, :, None, None]).clamp(0, 1)
    return replace(arc, train=replace(arc.train, images=images))


@pytest.fixture(scope="module")
def fit(exposed):
    return fit_scene(exposed, CONFIG)


def test_a_fit_of_photos_that_differ_is_as_good_as_of_photos_that_do_not(arc, exposed, fit):
    """Held-out views, after an affine fit of their colours; without gains they lose much."""
    torch.testing.assert_close(fit.scene.train.gains, centred(EXPOSURES), rtol=0.05, atol=0.0)
    same = fit_scene(exposed, replace(CONFIG, exposure="same"))
    assert same.scene.train.gains is None
    levels = [evaluate(f.render, arc.test, correct_color=True)["psnr"] for f in (fit, same, fit_scene(arc, CONFIG))]
    assert levels[0] > levels[2] - 1.0
    assert levels[0] > levels[1] + 2.0


def test_training_views_are_compared_as_they_were_exposed_and_both_measures_are_named(fit):
    metrics = measure(fit)
    assert metrics["train"]["psnr"] > metrics["test"]["psnr"]
    assert metrics["color_corrected"]["psnr"] > metrics["test"]["psnr"] + 1.0
    assert metrics["decisions"]["exposure"]["n"] >= MIN_PATCHES


def test_gains_of_another_number_of_photos_are_refused(arc):
    with refused(ArgumentError, name="gains"):
        with_exposure(arc, Decisions(exposure=ExposureDecision([[1.0, 1.0, 1.0]], 0.1, 500)))
    with refused(ArgumentError, name="gains"):
        replace(arc.train, gains=torch.zeros(6, 3))


def test_what_is_seen_through_a_photo_has_no_exposure():
    """A perfect render is its photo, over the background of the scene and over any other."""
    scene = synthetic_scene(size=(16, 24))
    draw = torch.Generator().manual_seed(0)
    alpha = torch.rand(len(scene.train), 1, 16, 24, generator=draw)
    surface = alpha * (0.2 + 0.5 * torch.rand(3, 16, 24, generator=draw))
    gain = torch.tensor([0.8, 1.0, 1.25])[:, None, None]
    for behind in (torch.zeros(3), torch.ones(3)):
        images = surface * gain + (1 - alpha) * behind[:, None, None]
        gains = gain[:, 0, 0].repeat(len(images), 1)
        target = targets(replace(scene.train, images=images, alphas=alpha, gains=gains), behind, torch.device("cpu"))[0]
        for color in (behind, torch.tensor([0.1, 0.6, 0.3])):
            view = target.over_background(color, "torch")
            render = surface[:1] + (1 - alpha[:1]) * view.background_before_gain(color)[:, None, None]
            torch.testing.assert_close(view.as_photographed(render), view.image, atol=1e-6, rtol=0)
            torch.testing.assert_close(view.image, surface[:1] * gain + (1 - alpha[:1]) * color[:, None, None])


def test_a_render_is_clamped_to_one_as_torch_clamps_it(scene):
    target = targets(scene.train, torch.zeros(3), torch.device("cpu"))[0]
    values = torch.tensor([-0.5, 0.0, 1.0 - 2.0**-24, 1.0, 1.0 + 2.0**-23, 3.0])
    render = values.repeat(16).view(1, 3, 4, 8).requires_grad_()
    weights = torch.arange(96.0).view(1, 3, 4, 8)
    seen, clamped = target.as_photographed(render), render.clamp(max=1.0)
    assert torch.equal(seen, clamped)
    gradients = [torch.autograd.grad((image * weights).sum(), render)[0] for image in (seen, clamped)]
    assert torch.equal(*gradients)


GAIN = torch.tensor([0.8, 0.7, 1.2])


@pytest.fixture(scope="module", params=[0.0, 1.0], ids=["black", "white"])
def see_through(request):
    """A fit that shows its photos: things before a background that no photo exposes, which differ in exposure."""
    scene = synthetic_scene(train_views=3, test_views=1, size=(48, 64))
    draw = torch.Generator().manual_seed(0)
    points = torch.rand(60, 3, generator=draw) * torch.tensor([2.0, 1.5, 1.0]) + torch.tensor([-1.0, -0.75, 3.0])
    to_world = torch.linalg.inv(scene.train.camera(1).extrinsics[0])
    points = points @ to_world[:3, :3].T + to_world[:3, 3]
    model = GaussianModel.from_points(points, 0.1 + 0.6 * torch.rand(60, 3, generator=draw), sh_degree=0)
    with torch.no_grad():
        model.opacity_logits.fill_(1.0)
    behind = torch.full((3,), request.param)
    renderer = GaussianRenderer().eval()
    parts = []
    for views in (scene.train, scene.test):
        rendered = [renderer(model(), views.camera(i), outputs=("image", "alpha")) for i in range(len(views))]
        surface = torch.cat([each.image for each in rendered]).detach()
        alpha = torch.cat([each.alpha for each in rendered]).detach()
        images = surface * GAIN[:, None, None] + (1 - alpha) * behind[:, None, None]
        parts.append(replace(views, images=images, alphas=alpha))
    assert 0.1 < float(parts[0].alphas.mean()) < 0.9
    train, test = parts
    gains = GAIN.repeat(len(train), 1)
    scene = replace(scene, train=replace(train, gains=gains), test=test, background=behind)
    config = settled(FitConfig(steps=1, evaluations=1))
    history = {"init": {"kind": "dense", "points": 60}, "poses": None}
    return Fit(scene, model, RasterOptions(), settings=config, history=history)


def test_a_background_that_shows_through_is_not_exposed_in_any_measure(see_through):
    scene = see_through.scene
    assert clipped_psnr(see_through.psnr(scene.train)) > 80
    assert min(psnr_per_view(see_through)) > 80
    metrics = measure(see_through)
    assert clipped_psnr(metrics["train"]["psnr"]) > 80
    assert metrics["test"]["psnr"] < 40
    assert clipped_psnr(metrics["color_corrected"]["psnr"]) > 60, "the colours of the scene alone are fitted"
    again = measure_again(see_through.annotated(metrics=metrics), Path("metrics.json"))
    assert again["train"] == metrics["train"]


def test_recoloured_renders_fit_best():
    """Against least squares of numpy."""
    draw = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, 5, 7, generator=draw)
    photo = torch.rand(3, 5, 7, generator=draw)
    found = color_corrected(image, image, photo)
    for k in range(3):
        columns = np.stack([image[0, k].flatten().numpy(), np.ones(35)], 1)
        best = columns @ np.linalg.lstsq(columns, photo[k].flatten().numpy(), rcond=None)[0]
        np.testing.assert_allclose(found[0, k].flatten().numpy(), best, atol=1e-5)
    flat = torch.full((1, 3, 5, 7), 0.25)
    torch.testing.assert_close(color_corrected(flat, flat, photo)[0].mean((1, 2)), photo.mean((1, 2)))


def test_only_what_counts_is_recoloured_by():
    """Pixels behind a mask are black in both pictures."""
    draw = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, 5, 8, generator=draw)
    counted = torch.zeros(1, 5, 8, dtype=torch.bool)
    counted[..., 4:] = True
    photo = (0.6 * image[0] + 0.2) * counted
    found = color_corrected(image, image * counted, photo, counted)
    torch.testing.assert_close(found, 0.6 * image + 0.2)
