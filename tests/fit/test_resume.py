"""A resumed fit is the same fit; a finished one can be trained on; a loop of one's own works."""

from dataclasses import replace

import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from refusals import refused
from torch import Tensor
from trainers import assert_same_bits, begun, fitted, stop_at

from kgs import ArgumentError, DataError
from kgs.fit import FitConfig, InitialPoints, Trainer
from kgs.fit.checkpoint import load_checkpoint, save_checkpoint
from kgs.fit.config import Recipe
from kgs.fit.decisions import Decisions, DegreeDecision, ExposureDecision, OverlapDecision
from kgs.fit.plan import make_plan

CONFIG = FitConfig(steps=6, drop=0.3, seed=5, evaluations=1, sh_degree=2, recipe=Recipe(grad_threshold=1e-5))
LONG = replace(CONFIG, steps=24, evaluations=3)  # densified after 10 and 20 steps
RESETS = replace(CONFIG.recipe, prune_opacity=0.005, reset_interval=3000, reset_recovery=5)
GAINS = ExposureDecision([[0.8, 0.8, 0.8], [1.0, 1.1, 1.0], [1.25, 1.0, 1.2]], 0.1, 500)
OPEN = {"steps": None, "drop": None, "sh_degree": None}
CHOSEN = {"steps": 24, "drop": 0.0, "sh_degree": 1}
WHY = {"overlap": OverlapDecision(8.0, 8.0, 500, steps=24, drop=0.0), "sh_degree": DegreeDecision(1, "rule")}

# what is in the state: after how many steps the fit stops, its settings, and what is decided about them and why
STATES = {
    "before most": (1, {}, {}, {}),
    "densified": (10, {}, {}, {}),
    "in a round of the views": (16, {}, {}, {}),
    "before the last step": (23, {}, {}, {}),
    "no dropping": (16, {"drop": 0.0}, {}, {}),
    "harmonics": (6, {"sh_degree": 3}, {}, {}),
    "one background": (16, {"training_background": "scene"}, {}, {}),
    "half the pixels": (7, {"coarse": 0.5}, {}, {}),
    "resets": (8, {"recipe": RESETS}, {}, {}),
    "poses": (16, {"refine_poses": True}, {}, {}),
    "haze": (51, {"steps": 56, "evaluations": 1}, {}, {}),
    "exposure": (16, {}, {}, {"exposure": GAINS}),
    "what was open": (16, OPEN, CHOSEN, WHY),
}


def assert_same_state(one, other, name="state"):
    """To the bit, but for times."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one.keys() - {"seconds"}:
            assert_same_state(one[key], other[key], f"{name}/{key}")
    elif isinstance(one, Tensor):
        assert torch.equal(one, other), name
    elif isinstance(one, list):
        for i, (first, second) in enumerate(zip(one, other, strict=True)):
            assert_same_state(first, second, f"{name}/{i}")
    else:
        assert one == other, name


@pytest.mark.usefixtures("each_backend")
@pytest.mark.parametrize(("step", "settings", "entries", "decisions"), STATES.values(), ids=STATES)
def test_a_stopped_and_resumed_fit_has_the_bits_of_one_that_was_not_stopped(
    scene, points, tmp_path, step, settings, entries, decisions
):
    config = replace(LONG, **settings)
    plan = make_plan(scene, replace(config, **entries), points)
    plan = replace(plan, decisions=Decisions(**decisions))
    whole, stopped = Trainer(scene, plan, points), Trainer(scene, plan, points)
    whole.fit()
    stopped.fit(stop_at(step))
    stopped.save(tmp_path / "checkpoint.safetensors")
    resumed = Trainer.resume(scene, config, tmp_path / "checkpoint.safetensors")
    assert_same_state(resumed.state_dict(), stopped.state_dict())
    assert torch.equal(resumed.scene.train.cameras.extrinsics, stopped.scene.train.cameras.extrinsics)
    assert resumed.step == step < resumed.fit().history["steps"]
    assert_same_state(resumed.state_dict(), whole.state_dict())


@pytest.fixture(scope="module")
def saved(scene, points, tmp_path_factory):
    path = tmp_path_factory.mktemp("fit") / "checkpoint.safetensors"
    trainer = begun(scene, points, CONFIG)
    trainer.fit(stop_at(2))
    trainer.save(path)
    return path


@pytest.fixture(scope="module")
def done(each_backend, scene, points):
    """A fit that was left alone."""
    return fitted(scene, points, CONFIG)


# -- what does not belong to the checkpoint ------------------------------------------------------------------------


def changed(scene, part, **changes):
    """The scene with other values in one of its groups of views."""
    views = getattr(scene, part)
    cameras = views.cameras
    values = {"images": views.images, "extrinsics": cameras.extrinsics, "intrinsics": cameras.intrinsics}
    for name, change in changes.items():
        values[name] = change(values[name].clone())
    cameras = PinholeCamera(values["intrinsics"], values["extrinsics"], cameras.height, cameras.width)
    return replace(scene, **{part: replace(views, cameras=cameras, images=values["images"])})


def first_two_exchanged(tensor):
    return tensor[[1, 0, *range(2, len(tensor))]]


def nudged(tensor):
    tensor.view(-1)[7] += 1e-6
    return tensor


EVERYWHERE = torch.ones(3, 32, 40, dtype=torch.bool)
TENSORS = [
    ("images", first_two_exchanged, "photos"),
    ("images", nudged, "photos"),
    ("extrinsics", first_two_exchanged, "poses"),
    ("extrinsics", nudged, "poses"),
    ("intrinsics", nudged, "intrinsics"),
]
OTHER_SCENES = [
    (f"{said} of the {part} views", lambda scene, group=group, change={name: change}: changed(scene, group, **change))
    for group, part in (("train", "training"), ("test", "test"))
    for name, change, said in TENSORS
]
OTHER_SCENES += [
    (f"{said} of the training views", lambda scene, change=change: replace(scene, train=change(scene.train)))
    for said, change in (
        ("names", lambda views: views.select([0, 1])),
        ("alphas", lambda views: replace(views, alphas=torch.ones(3, 1, 32, 40))),
        ("valid pixels", lambda views: replace(views, valid_mask=EVERYWHERE)),
    )
]
OTHER_SCENES += [("background", lambda scene: replace(scene, background=torch.ones(3)))]
OTHER_SETTINGS = [
    ("seed", "5", {"seed": 6}),
    ("drop", "0", {"drop": 0.0}),
    ("sh_degree", "2", {"sh_degree": 1}),
    ("refine_poses", "False", {"refine_poses": True}),
    ("max_gaussians", "", {"max_gaussians": 99}),
    ("recipe.grad_threshold", "1e-05", {"recipe": Recipe(grad_threshold=2e-5)}),
    ("steps", "6", {"steps": 7}),
    ("steps", "6", {"steps": 1}),
]


@pytest.mark.parametrize(("key", "change"), OTHER_SCENES)
def test_what_is_another_scene_is_named(scene, saved, key, change):
    with refused(DataError, path=saved, key=key):
        Trainer.resume(change(scene), CONFIG, saved)


@pytest.mark.parametrize(("key", "begun_with", "change"), OTHER_SETTINGS)
def test_another_setting_is_named_with_what_the_fit_was_begun_with(scene, saved, key, begun_with, change):
    with refused(DataError, path=saved, key=key) as error:
        Trainer.resume(scene, replace(CONFIG, **change), saved)
    assert error.value.expected.startswith(begun_with)


@pytest.mark.parametrize(
    "name", ["config", "scene", "model", "optimizer", "densifier", "order", "drop", "step", "stack"]
)
def test_a_wrong_entry_is_a_data_error(scene, saved, tmp_path, name):
    path = tmp_path / "checkpoint.safetensors"
    state = load_checkpoint(saved)
    others = [None, 7.5, "text", {}]
    if name != "stack":  # which is empty after each round of the views
        others.append([])
    without = {key: value for key, value in state.items() if key != name}
    for values in (without, *({**state, name: value} for value in others)):
        save_checkpoint(path, values)
        with refused(DataError, path=path):
            Trainer.resume(scene, CONFIG, path)


def test_poses_of_another_number_of_photos_are_refused(scene, points):
    trainer = begun(scene, points, CONFIG, refine_poses=True)
    state = trainer.state_dict()
    state["poses"]["extrinsics"] = state["poses"]["extrinsics"][:2]
    with refused(ArgumentError, name="poses"):
        trainer.load_state_dict(state)


def test_a_mistake_in_kgs_or_of_the_caller_is_no_fault_of_the_checkpoint(scene, saved, monkeypatch):
    for arguments, name in ((("scene", CONFIG), "scene"), ((scene, CONFIG.to_dict()), "config")):
        with pytest.raises(TypeError, match=f"^{name}: expected"):
            Trainer.resume(*arguments, saved)
    with refused(ArgumentError, name="device"):
        Trainer.resume(scene, replace(CONFIG, device="meta"), saved)

    def fail(*_, **__):
        raise torch.OutOfMemoryError

    monkeypatch.setattr("kgs.fit.state.GaussianModel", fail)
    with pytest.raises(torch.OutOfMemoryError):
        Trainer.resume(scene, CONFIG, saved)


# -- what may change -----------------------------------------------------------------------------------------------


def test_a_fit_may_go_on_on_another_device(scene, saved):
    state = Trainer.resume(scene, replace(CONFIG, device="cpu:0"), saved).state
    assert state.step == 2
    streams = [state.order.get_state(), state.drop.get_rng_state(), state.densifier.generator.get_state()]
    assert {stream.device.type for stream in streams} == {"cpu"}


def test_a_finished_fit_can_be_trained_on_and_says_what_that_means(scene, done, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    done.save(path)
    longer = replace(CONFIG, steps=9)
    with refused(DataError, key="steps", expected="at least the 6 that are done", got="5"):
        Trainer.resume(scene, replace(CONFIG, steps=5), path)
    trainer = Trainer.resume(scene, longer, path)
    assert [note for note in trainer.state.notes if "from step 6" in note and "fit of 9 steps from the start" in note]
    trainer.fit(stop_at(7))
    assert trainer.state.drop.progress == 7 / 9
    assert trainer.model.sh_degree == done.model.sh_degree == 2  # nothing learned is switched off
    trainer.save(path)
    again = Trainer.resume(scene, longer, path)
    trainer.fit()
    again.fit()
    assert_same_state(again.state_dict(), trainer.state_dict())
    assert [point["step"] for point in again.state.curve] == [6, 9]
    again.save(path)
    many = Trainer.resume(scene, replace(CONFIG, steps=1001), path)
    assert many.plan.config.recipe == again.plan.config.recipe  # of itself so long a fit would fade more slowly


def test_a_loop_of_ones_own(scene, points, done):
    by_hand = begun(scene, points, CONFIG)
    losses = []
    kept = None
    while by_hand.step < CONFIG.steps:
        losses.append(by_hand.train_step())
        if by_hand.step == 3:
            kept = by_hand.state_dict()
    assert_same_bits(by_hand, done)
    with pytest.raises(ValueError, match="steps"):
        by_hand.train_step()
    other = begun(scene, InitialPoints(points.points[:20], points.colors[:20], "random"), CONFIG)
    plan = other.plan
    with refused(ArgumentError, name="decisions"):
        other.load_state_dict(kept | {"decisions": {"exposure": {}}})
    assert (other.step, other.plan) == (0, plan)
    for trainer in (other, by_hand, Trainer(scene, plan, kept)):  # a fresh one, back in time, and from the state
        trainer.load_state_dict(kept)
        assert trainer.step == 3
        assert [trainer.train_step() for _ in range(3)] == losses[3:]
        assert_same_bits(trainer, done)


@pytest.mark.usefixtures("each_backend")
@pytest.mark.parametrize("photo", [0.0, 1.0])
def test_photos_of_one_colour_can_be_fitted_and_met_exactly(scene, points, tmp_path, photo):
    """All black over black, or white over white; the test view has nothing of the scene in sight."""
    away = scene.test.cameras.extrinsics.clone()
    away[:, :3, 3] += torch.tensor([0.0, 0.0, -1e6])
    blank = changed(scene, "test", extrinsics=lambda _: away, images=lambda images: torch.full_like(images, photo))
    blank = changed(blank, "train", images=lambda images: torch.full_like(images, photo))
    trainer = fitted(replace(blank, background=torch.full((3,), photo)), points, CONFIG)
    assert trainer.step == CONFIG.steps
    assert trainer.state.curve[-1]["test_psnr"] is None
    assert trainer.state.curve[-1]["train_psnr"] > 0
    trainer.save(tmp_path / "checkpoint.safetensors")
