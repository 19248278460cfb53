"""Trainer: determinism, what it does in which step, where it stops, and that nothing depends on the test views."""

import math
from dataclasses import replace
from functools import partial
from itertools import pairwise, product

import pytest
import torch
import trainers
from kornia.geometry.camera import PinholeCamera
from trainers import assert_same_bits, stop_at

from kgs import TrainingDiverged
from kgs.datasets.scene import Views
from kgs.densify import Densifier
from kgs.fit.config import PAPER, FitConfig, Recipe
from kgs.init_points import InitialPoints
from kgs.renderer import GaussianRenderer

CONFIG = FitConfig(steps=30, drop=0.3, seed=5, evaluations=3, recipe=Recipe(grad_threshold=1e-5))
begun = partial(trainers.begun, config=CONFIG)
fitted = partial(trainers.fitted, config=CONFIG)


def parameters(trainer):
    return {name: value.detach().clone() for name, value in trainer.model.named_parameters()}


@pytest.fixture(scope="module")
def whole(each_backend, scene, points):
    return fitted(scene, points)


def test_it_learns(whole, scene, points):
    curve = whole.state.curve
    assert [point["step"] for point in curve] == [10, 20, 30]
    assert curve[-1]["train_psnr"] > curve[0]["train_psnr"]
    assert curve[-1]["train_psnr"] > begun(scene, points).result().psnr(scene.train) + 1
    assert all(a["seconds"] < b["seconds"] for a, b in pairwise(curve))


def test_a_fit_has_the_same_bits_on_any_number_of_threads(set_threads, scene):
    count = 40_000  # torch divides nothing smaller than 32768
    points = InitialPoints(torch.rand(count, 3) + torch.tensor([-0.5, -0.5, 2.0]), torch.rand(count, 3), "random")
    trainers = [begun(scene, points) for _ in range(2)]
    for threads, trainer in zip((1, 3), trainers, strict=True):
        set_threads(threads)
        for _ in range(4):
            trainer.train_step()
        assert torch.get_num_threads() == threads
    assert_same_bits(*trainers)


DECAYED = Recipe(opacity_decay=0.9, decay_from=0.5)
RESETS = Recipe(prune_opacity=0.005, opacity_decay=1.0, reset_interval=3000, reset_recovery=5)


@pytest.mark.parametrize(
    ("recipe", "name", "value", "steps"),
    [
        (DECAYED, "decay_opacity", 0.9, range(16, 30)),  # the last step only looks
        (RESETS, "reset_opacity", RESETS.reset_opacity, (9, 18)),
    ],
)
def test_opacities_decay_or_are_reset_when_the_schedule_says(scene, points, monkeypatch, recipe, name, value, steps):
    done = []
    for method in ("decay_opacity", "reset_opacity"):
        monkeypatch.setattr(Densifier, method, lambda _, given, of=method: done.append((of, trainer.step, given)))
    trainer = begun(scene, points, recipe=recipe)
    trainer.fit()
    assert done == [(name, step, value) for step in steps]


def test_harmonics_come_one_degree_after_the_other(scene, points):
    trainer = begun(scene, points, sh_degree=3)
    degrees = []
    trainer.fit(lambda trainer, _: degrees.append(trainer.model.sh_degree))
    assert degrees == sorted(degrees)
    assert [degrees.index(degree) + 1 for degree in (1, 2, 3)] == list(trainer.plan.schedule.sh)


def test_another_seed_other_bits(each_backend, scene, points):
    means = []
    for seed in (5, 6):
        trainer = begun(scene, points, seed=seed)
        trainer.fit(stop_at(3))
        means.append(trainer.model.means)
    assert not torch.equal(*means)


def test_with_and_without_drop_see_the_same_views(scene, points):
    orders = []
    for drop in (0.0, 0.5):
        trainer = begun(scene, points, drop=drop)
        assert (trainer.state.drop is None) == (drop == 0.0)
        orders.append([trainer._next_view() for _ in range(20)])
    assert orders[0] == orders[1]


def test_test_views_never_matter(whole, scene, points):
    cameras = scene.test.cameras
    extrinsics = cameras.extrinsics.clone()
    extrinsics[:, :3, 3] += 0.5
    moved = PinholeCamera(cameras.intrinsics, extrinsics, cameras.height, cameras.width)
    other = Views(moved, torch.rand(scene.test.images.shape), scene.test.names)
    assert_same_bits(whole, fitted(replace(scene, test=other), points))
    without = fitted(replace(scene, test=scene.test.select([])), points)
    assert_same_bits(whole, without)
    assert without.state.curve[-1]["test_psnr"] is None


def test_a_limit_that_leaves_no_room_holds_and_is_said_once(scene, points):
    trainer = fitted(scene, points, max_gaussians=170)
    assert len(trainer.model) <= 170
    assert len(trainer.state.notes) == 1
    assert "max_gaussians: 170 leaves little room beside the 150 initial points" in trainer.state.notes[0]


def test_the_usual_limit_is_reached_without_a_word(whole, points):
    assert len(whole.model) == 10 * CONFIG.steps > len(points.points)
    assert whole.state.notes == []


def test_a_fit_has_gradients_where_they_are_switched_off_around_it(scene, points):
    trainer, same = begun(scene, points), begun(scene, points)
    with torch.no_grad():
        losses = [trainer.train_step() for _ in range(3)]
    assert [same.train_step() for _ in range(3)] == losses
    for name, value in parameters(same).items():
        assert torch.equal(parameters(trainer)[name], value)
    with torch.inference_mode(), pytest.raises(RuntimeError, match="inference_mode"):
        trainer.train_step()
    assert trainer.step == 3


PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "sh_dc")


def test_it_stops_before_a_gradient_that_is_not_finite_is_applied(each_backend, scene, points):
    trainer = begun(scene, points)
    start = trainer.state_dict()
    for name in PARAMETERS:
        trainer.load_state_dict(start)
        before = parameters(trainer)
        poison = torch.ones_like(trainer.model.get_parameter(name))
        poison[7] = torch.nan
        trainer.model.get_parameter(name).register_hook(lambda gradient, poison=poison: gradient * poison)
        with pytest.raises(TrainingDiverged, match=f"step 1.*{name}.*Gaussian 7"):
            trainer.fit()
        assert all(torch.equal(value, before[key]) for key, value in parameters(trainer).items()), name


def test_it_stops_at_a_parameter_that_is_not_finite(each_backend, scene, points, tmp_path):
    trainer = begun(scene, points)
    trainer.fit(stop_at(2))
    trainer.save(tmp_path / "checkpoint.safetensors")
    second = trainer.state_dict()
    said = r"step 3.*{} of Gaussian 7.*checkpoint\.safetensors of step 2"
    for name, value in product(PARAMETERS, (torch.nan, torch.inf)):
        trainer.load_state_dict(second)
        with torch.no_grad():
            trainer.model.get_parameter(name)[7] = value
        if name == "opacity_logits" and value == torch.inf:  # an opacity of 1
            trainer.fit()
            assert trainer.step == CONFIG.steps
            continue
        with pytest.raises(TrainingDiverged, match=said.format(name)):
            trainer.fit()


def test_it_stops_at_a_gradient_whose_square_overflows(scene, points):
    trainer = begun(scene, points)
    trainer.model.means.register_hook(lambda gradient: gradient.index_fill(0, torch.tensor([4]), 1e20))
    with pytest.raises(TrainingDiverged, match="step 1.*below 1e19.*means of Gaussian 4.*no checkpoint yet"):
        trainer.fit()


def test_it_stops_where_scales_explode(scene, points):
    trainer = begun(scene, points)
    trainer.fit(stop_at(min(trainer.plan.schedule.densify) - 1))
    with torch.no_grad():
        trainer.model.log_scales[3, 1] = 40.0
    with pytest.raises(TrainingDiverged, match="scales below 1e[+]06 times the extent.*Gaussian 3"):
        trainer.fit()


def test_scales_that_grow_without_end_are_bounded(scene, points):
    """As those of the sky do in a long fit: no photo tells them from larger ones, and the fit goes on."""
    trainer = begun(scene, points)
    with torch.no_grad():
        trainer.model.log_scales[3, 1] = math.log(5e5 * trainer.state.start.extent)
    trainer.fit(stop_at(20))
    assert trainer.model.log_scales.max() <= math.log(1.0001e4 * trainer.state.start.extent)
    trainer.fit()


def test_the_memory_budget_reaches_the_renderer(scene, points):
    small = begun(scene, points, max_bytes=1000)
    with pytest.raises(ValueError, match="max_bytes"):
        small.fit()


def test_the_drop_rate_rises_to_the_end_and_renders_and_the_last_tenth_drop_nothing(scene, points):
    trainer = begun(scene, points, steps=20, evaluations=1)
    rates, active = [], []

    def note(trainer, _):
        rates.append(trainer.state.drop.rate)
        active.append(trainer.state.drop.training)
        assert torch.equal(*(trainer.result().render(scene.train.camera(0)) for _ in range(2)))  # of all Gaussians

    trainer.fit(note)
    assert rates == pytest.approx([0.3 * step / 20 for step in range(1, 21)])
    assert active[:-1] == [True] * 18 + [False]  # the curve is measured after the last one


@pytest.mark.parametrize(
    ("recipe", "early", "late"),
    [
        (Recipe(), 2 / 255, 1 / 255),
        (PAPER.recipe, 1 / 255, 1 / 255),
        (Recipe(alpha_threshold=0.0), 0.0, 0.0),
        (Recipe(alpha_threshold=0.1, threshold_until=1.0), 0.1, 0.1),
    ],
)
def test_the_last_steps_skip_no_more_than_all_other_renders(scene, points, recipe, early, late):
    trainer = begun(scene, points, steps=6, recipe=recipe)
    thresholds = []
    trainer.fit(lambda trainer, _: thresholds.append(trainer.renderer.options.alpha_threshold))
    assert thresholds == [early] * 4 + [late] * 2
    assert trainer.result().options.alpha_threshold == 1 / 255


def test_the_first_steps_may_see_half_the_pixels(scene, points):
    trainer = begun(scene, points, coarse=0.5, steps=6, evaluations=1)
    sizes = []
    trainer.renderer.register_forward_hook(lambda *args: sizes.append(tuple(args[2].image.shape[-2:])))
    trainer.fit()
    assert sizes == [(16, 20)] * 3 + [(32, 40)] * 3


# -- backgrounds ------------------------------------------------------------------------------------------------------


def mean_alpha(trainer):
    """Of the first training view."""
    renderer = GaussianRenderer(near_plane=trainer.state.start.near_plane).eval()
    with torch.no_grad():
        return float(renderer(trainer.model(), trainer.scene.train.camera(0), outputs=("alpha",)).alpha.mean())


@pytest.mark.slow
def test_dark_photos_become_opaque_before_random_backgrounds_alone(scene, points):
    """Where the background is black, nothing says whether a dark photo is transparent."""
    dark = replace(scene, train=replace(scene.train, images=torch.zeros_like(scene.train.images)))
    seen = {}
    for background in ("random", "scene"):
        trainer = fitted(dark, points, steps=60, drop=0.0, training_background=background)
        seen[background] = mean_alpha(trainer)
    assert seen["random"] > 1.5 * seen["scene"]
