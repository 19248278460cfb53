"""The one way through a fit: its order, what callers add to it, and that `kgs fit` goes no other."""

from dataclasses import replace

import pytest
import torch
from fits_in_folders import fit_in
from refusals import refused
from trainers import stop_at

from kgs import ArgumentError, DataError
from kgs.app.scene_request import SceneRequest
from kgs.datasets import synthetic_scene
from kgs.fit import FitConfig, Hooks, Trainer, fit_scene, make_plan, prune
from kgs.fit.config import Recipe
from kgs.fit.run import choose_points

CONFIG = FitConfig(steps=12, init="random", init_points=60, evaluations=2, recipe=Recipe(grad_threshold=1e-5))


def assert_same_model(one, other):
    for name, value in one.model.state_dict().items():
        assert torch.equal(value, other.model.state_dict()[name]), name


@pytest.fixture(scope="module")
def whole(scene):
    return fit_scene(scene, CONFIG)


def test_it_is_the_steps_that_can_be_made_by_hand(scene, whole):
    points = choose_points(scene, CONFIG)
    by_hand = prune(Trainer(scene, make_plan(scene, CONFIG, points), points).fit())
    assert_same_model(whole, by_hand)
    assert whole.decisions == by_hand.decisions
    assert_same_model(whole, fit_scene(scene, CONFIG, points=points))


def test_kgs_fit_makes_the_same_fit(scene, whole, tmp_path):
    published = fit_in(scene, CONFIG, tmp_path, SceneRequest("/photos"), say=lambda _: None)
    assert_same_model(whole, published.fit)
    assert whole.decisions == published.fit.decisions


def test_hooks_are_called_in_the_order_of_the_fit(scene, whole):
    calls = []

    class Other(Trainer):
        pass

    def bar(items, title, unit):
        calls.append("points")
        return items

    hooks = Hooks(
        bar=bar,
        make_trainer=lambda *arguments: calls.append("trainer") or Other(*arguments),
        begun=lambda trainer: calls.append((type(trainer), trainer.step)),
        after_step=lambda trainer, loss: bool(calls.append(trainer.step)),
        done=lambda trainer, fit: calls.append((trainer.step, len(fit.model))),
    )
    assert_same_model(whole, fit_scene(scene, replace(CONFIG, init="random"), hooks=hooks))
    first = calls.index("trainer")
    assert set(calls[:first]) <= {"points"}
    assert calls[first + 1 :] == [(Other, 0), *range(1, 13), (12, len(whole.model))]


def test_a_fit_that_was_stopped_goes_on_from_its_checkpoint(scene, whole, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    hooks = Hooks(after_step=stop_at(5), done=lambda trainer, _: trainer.save(path))
    assert fit_scene(scene, CONFIG, hooks=hooks).history["steps"] == 5
    begun = []
    resumed = fit_scene(scene, CONFIG, resume=path, hooks=Hooks(begun=lambda trainer: begun.append(trainer.step)))
    assert begun == [5]
    assert_same_model(whole, resumed)


@pytest.mark.parametrize("left_open", [{"steps": None}, {"drop": None}, {"sh_degree": None}, {"coarse": None}])
def test_what_is_left_open_is_as_the_fit_was_begun_with(scene, tmp_path, left_open):
    path = tmp_path / "checkpoint.safetensors"
    config = replace(CONFIG, drop=0.1, sh_degree=1, coarse=0.5)
    hooks = Hooks(after_step=stop_at(1), done=lambda trainer, _: trainer.save(path))
    begun = fit_scene(scene, config, hooks=hooks)
    resumed = fit_scene(scene, replace(config, **left_open), resume=path, hooks=Hooks(after_step=stop_at(2)))
    assert resumed.settings == begun.settings


def test_what_needs_no_points_is_checked_before_them(scene, monkeypatch):
    monkeypatch.setattr("kgs.fit.run.choose_points", None)
    small = synthetic_scene(train_views=2, size=(8, 9))
    with refused(ArgumentError, name="device"):
        fit_scene(scene, replace(CONFIG, device="meta"))
    with refused(DataError, key="images", got="9x8"):
        fit_scene(small, replace(CONFIG, coarse=0.5))
    with pytest.raises(TypeError, match="config"):
        fit_scene(scene, CONFIG.to_dict())
