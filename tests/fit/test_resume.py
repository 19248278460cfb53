"""A resumed fit is the same fit; a finished one can be trained on; a loop of one's own works."""

from dataclasses import replace

import pytest
import torch
from kornia.geometry.camera import PinholeCamera

from kgs import DataError
from kgs.fit import FitConfig, InitialPoints, Trainer
from kgs.fit.checkpoint import load_checkpoint, save_checkpoint
from kgs.fit.config import Recipe
from kgs.fit.plan import make_plan

pytestmark = pytest.mark.usefixtures("each_backend")

CONFIG = FitConfig(steps=6, drop=0.3, seed=5, evaluations=1, sh_degree=2, recipe=Recipe(grad_threshold=1e-5))


@pytest.fixture(scope="module")
def saved(each_backend, scene, points, tmp_path_factory):
    path = tmp_path_factory.mktemp("fit") / "checkpoint.safetensors"
    trainer = Trainer(scene, make_plan(scene, CONFIG), points)
    trainer.fit(lambda trainer, _: trainer.step == 2)
    trainer.save(path)
    return path


@pytest.fixture(scope="module")
def done(each_backend, scene, points):
    """A fit that was left alone."""
    trainer = Trainer(scene, make_plan(scene, CONFIG), points)
    trainer.fit()
    return trainer


def assert_same_bits(a, b):
    for (name, one), (_, other) in zip(a.model.named_parameters(), b.model.named_parameters(), strict=True):
        assert torch.equal(one, other), name


def changed(scene, part, **changes):
    """The scene with other values in one of its groups of views; "swap" exchanges the first two."""
    views = getattr(scene, part)
    cameras = views.cameras
    values = {"images": views.images, "extrinsics": cameras.extrinsics, "intrinsics": cameras.intrinsics}
    for name, change in changes.items():
        values[name] = change(values[name].clone())
    cameras = PinholeCamera(values["intrinsics"], values["extrinsics"], cameras.height, cameras.width)
    return replace(scene, **{part: replace(views, cameras=cameras, images=values["images"])})


def swap(tensor):
    return tensor[[1, 0, *range(2, len(tensor))]]


def nudge(tensor):
    tensor.view(-1)[7] += 1e-6
    return tensor


@pytest.mark.usefixtures("torch_alone")
@pytest.mark.parametrize("part", ["train", "test"])
@pytest.mark.parametrize("change", [swap, nudge])
@pytest.mark.parametrize(
    ("name", "said"), [("images", "photos"), ("extrinsics", "poses"), ("intrinsics", "intrinsics")]
)
def test_another_photo_pose_or_matrix_is_named(scene, saved, part, change, name, said):
    if name == "intrinsics" and change is swap:  # they are all the same
        other = changed(scene, part, intrinsics=lambda k: k * torch.linspace(1, 1.1, len(k))[:, None, None])
    else:
        other = changed(scene, part, **{name: change})
    with pytest.raises(DataError, match=f"{said} of the {part}.*views: expected those that the fit was begun with"):
        Trainer.resume(other, CONFIG, saved)


@pytest.mark.usefixtures("torch_alone")
def test_other_views_masks_and_background_are_named(scene, saved):
    views = scene.train
    for other, said in (
        (replace(scene, train=views.select([0, 1])), "names of the training views"),
        (replace(scene, train=replace(views, alphas=torch.ones(3, 1, 32, 40))), "alphas of the training views"),
        (
            replace(scene, train=replace(views, valid_mask=torch.ones(3, 32, 40, dtype=torch.bool))),
            "valid pixels of the training views",
        ),
        (replace(scene, background=torch.tensor([1.0, 1.0, 1.0])), "background"),
    ):
        with pytest.raises(DataError, match=said):
            Trainer.resume(other, CONFIG, saved)


@pytest.mark.usefixtures("torch_alone")
@pytest.mark.parametrize(
    ("change", "flag"),
    [
        ({"seed": 6}, "seed: expected 5, as the fit was begun with, got 6"),
        ({"drop": 0.0}, "drop: expected 0"),
        ({"sh_degree": 1}, "sh_degree: expected 2"),
        ({"refine_poses": True}, "refine_poses: expected False"),
        ({"max_gaussians": 99}, "max_gaussians"),
        ({"recipe": Recipe(grad_threshold=2e-5)}, "recipe.grad_threshold: expected 1e-05"),
        ({"steps": 7}, "steps: expected 6, as the fit was begun with, got 7"),
        ({"steps": 1}, "steps: expected 6"),
    ],
)
def test_another_setting_is_named_by_its_flag(scene, saved, change, flag):
    with pytest.raises(DataError, match=flag):
        Trainer.resume(scene, replace(CONFIG, **change), saved)


def test_a_mistake_in_kgs_or_of_the_caller_is_no_fault_of_the_checkpoint(scene, saved, monkeypatch):
    for arguments, name in ((("scene", CONFIG), "scene"), ((scene, CONFIG.to_dict()), "config")):
        with pytest.raises(TypeError, match=f"^{name}: expected"):
            Trainer.resume(*arguments, saved)
    with pytest.raises(ValueError, match="^device: expected"):
        Trainer.resume(scene, replace(CONFIG, device="meta"), saved)

    def broken(*_, **__):
        raise TypeError("unsupported operand")

    for function in ("kgs.fit.trainer.make_plan", "kgs.fit.state.TrainState._assemble", "kgs.fit.trainer.targets"):
        with monkeypatch.context() as patch:
            patch.setattr(function, broken)
            with pytest.raises(TypeError, match="unsupported operand"):
                Trainer.resume(scene, CONFIG, saved)

    def without_memory(*_, **__):
        raise torch.OutOfMemoryError("out of memory")

    monkeypatch.setattr("kgs.fit.state.GaussianModel", without_memory)
    with pytest.raises(torch.OutOfMemoryError):
        Trainer.resume(scene, CONFIG, saved)


def test_a_fit_may_go_on_on_another_device(scene, saved):
    resumed = Trainer.resume(scene, replace(CONFIG, device="cpu:0"), saved)
    assert resumed.step == 2
    streams = [
        resumed.state.order.get_state(),
        resumed.state.drop.get_rng_state(),
        resumed.state.densifier.generator.get_state(),
    ]
    assert {stream.device.type for stream in streams} == {"cpu"}


def test_a_finished_fit_can_be_trained_on_and_says_what_that_means(scene, done, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    done.save(path)
    longer = replace(CONFIG, steps=9)
    with pytest.raises(DataError, match="steps: expected at least the 6 that are done, got 5"):
        Trainer.resume(scene, replace(CONFIG, steps=5), path)
    trainer = Trainer.resume(scene, longer, path)
    assert [note for note in trainer.state.notes if "from step 6" in note and "fit of 9 steps from the start" in note]
    trainer.fit(lambda trainer, _: trainer.step == 7)
    assert trainer.state.drop.progress == 7 / 9
    assert trainer.model.sh_degree == done.model.sh_degree == 2  # nothing learned is switched off
    trainer.save(path)
    again = Trainer.resume(scene, longer, path)
    assert again.state.notes == trainer.state.notes
    trainer.fit()
    again.fit()
    assert_same_bits(trainer, again)
    assert [point["step"] for point in again.state.curve] == [6, 9]
    again.save(path)
    many = Trainer.resume(scene, replace(CONFIG, steps=1001), path)
    assert many.plan.config.recipe == again.plan.config.recipe  # of itself so long a fit would fade more slowly


def test_a_loop_of_ones_own(scene, points, done):
    plan = make_plan(scene, CONFIG)
    by_hand = Trainer(scene, plan, points)
    losses = []
    kept = None
    while by_hand.step < CONFIG.steps:
        losses.append(by_hand.train_step())
        if by_hand.step == 3:
            kept = by_hand.state_dict()
    assert_same_bits(by_hand, done)
    with pytest.raises(ValueError, match="steps"):
        by_hand.train_step()
    other = Trainer(scene, plan, InitialPoints(points.points[:20], points.colors[:20], "random"))
    with pytest.raises(ValueError, match="^decisions: "):
        other.load_state_dict(kept | {"decisions": {"exposure": {}}})
    assert (other.step, other.plan) == (0, plan)
    for trainer in (other, by_hand, Trainer(scene, plan, kept)):  # a fresh one, back in time, and from the state
        trainer.load_state_dict(kept)
        assert trainer.step == 3
        assert [trainer.train_step() for _ in range(3)] == losses[3:]
        assert_same_bits(trainer, done)


@pytest.mark.usefixtures("torch_alone")
@pytest.mark.parametrize(
    "name", ["config", "scene", "model", "optimizer", "densifier", "order", "drop", "step", "stack"]
)
@pytest.mark.parametrize("value", [None, 7.5, "gone", [], {}])
def test_a_wrong_entry_is_a_data_error(scene, saved, tmp_path, name, value):
    state = load_checkpoint(saved)
    state[name] = value
    if value == "gone":
        del state[name]
    if (name, value) == ("stack", []):
        pytest.skip("it is empty after each round of the views")
    save_checkpoint(tmp_path / "checkpoint.safetensors", state)
    with pytest.raises(DataError, match=r"checkpoint\.safetensors"):
        Trainer.resume(scene, CONFIG, tmp_path / "checkpoint.safetensors")


@pytest.mark.parametrize("photo", [0.0, 1.0])
def test_photos_of_one_colour_can_be_fitted_and_met_exactly(scene, points, tmp_path, photo):
    """All black over black, or white over white; the test view has nothing of the scene in sight."""
    away = scene.test.cameras.extrinsics.clone()
    away[:, :3, 3] += torch.tensor([0.0, 0.0, -1e6])
    blank = changed(scene, "test", extrinsics=lambda _: away, images=lambda images: torch.full_like(images, photo))
    blank = changed(blank, "train", images=lambda images: torch.full_like(images, photo))
    blank = replace(blank, background=torch.full((3,), photo))
    trainer = Trainer(blank, make_plan(blank, CONFIG), points)
    trainer.fit()
    assert trainer.step == CONFIG.steps
    assert trainer.state.curve[-1]["test_psnr"] is None
    assert trainer.state.curve[-1]["train_psnr"] > 0
    trainer.save(tmp_path / "checkpoint.safetensors")


def test_a_program_in_float64_fits_the_same_bits(scene, points, done):
    torch.set_default_dtype(torch.float64)
    try:
        trainer = Trainer(scene, make_plan(scene, CONFIG), points)
        trainer.fit()
    finally:
        torch.set_default_dtype(torch.float32)
    assert_same_bits(trainer, done)
