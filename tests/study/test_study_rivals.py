"""Scores of Gaussians, and the fits that use them."""

from dataclasses import replace

import pytest
import torch

from kgs.fit.config import FitConfig, Recipe
from kgs.fit.plan import make_plan
from kgs.fit.trainer import Trainer
from kgs.study.rivals import Rival, RivalTrainer, gaussian_scores

CONFIG = FitConfig(steps=40, drop=0.4, seed=2, evaluations=1, recipe=Recipe(grad_threshold=1e-5))


def train(trainer, steps):
    """Train until so many steps are done."""
    trainer.fit(lambda trainer, _: trainer.step == steps)
    return trainer


def test_distances_are_those_to_the_cameras_centre(scene, points):
    trainer = Trainer(scene, make_plan(scene, CONFIG), points)
    for view in range(3):
        camera = scene.train.camera(view)
        rotation, shift = camera.extrinsics[0, :3, :3], camera.extrinsics[0, :3, 3]
        in_camera = points.points @ rotation.T + shift
        far = gaussian_scores("far", trainer.state.densifier, camera)
        torch.testing.assert_close(far, in_camera.norm(dim=1), rtol=1e-5, atol=1e-5)
        assert torch.equal(gaussian_scores("near", trainer.state.densifier, camera), -far)


def test_gradients_are_means_of_what_the_densifier_observed(scene, points):
    config = replace(CONFIG, recipe=Recipe(grad_threshold=1e9))
    trainer = train(Trainer(scene, make_plan(scene, config), points), 9)  # before the first densification
    state = trainer.state.densifier.state_dict()
    expected = state["gradient_sums"] / (1 + state["counts"])
    assert float(expected.max()) > 0
    high = gaussian_scores("high-gradient", trainer.state.densifier, scene.train.camera(0))
    torch.testing.assert_close(high, expected)
    assert torch.equal(gaussian_scores("low-gradient", trainer.state.densifier, scene.train.camera(0)), -high)


@pytest.mark.parametrize("by", ["high-gradient", "low-gradient", "near", "far"])
def test_the_trainer_sets_the_scores_of_the_present_camera(scene, points, by):
    trainer = RivalTrainer(scene, make_plan(scene, CONFIG), points, Rival(drop_by=by))
    seen, cameras = [], []

    def check(module, inputs, output):
        if module.training:
            assert torch.equal(module.scores, gaussian_scores(by, trainer.state.densifier, cameras[-1]))
        seen.append((module.scores.clone(), inputs[0].detach(), output.detach(), module.rate))

    trainer.renderer.register_forward_pre_hook(lambda _, inputs: cameras.append(inputs[1]))
    trainer.state.drop.register_forward_hook(check)
    train(trainer, 12)
    assert len({tuple(camera.extrinsics.flatten().tolist()) for camera in cameras}) > 1
    for scores, before, after, rate in seen:
        dropped = (after == 0) & (before > 0)
        assert int(dropped.sum()) == round(rate * len(before))
        if dropped.any():
            assert float(scores[dropped].min()) >= float(scores[~dropped].max())
    assert trainer.renderer.eval().opacity_layer(before) is before


def test_a_rival_that_is_none_is_the_fit_itself(scene, points):
    plan = make_plan(scene, CONFIG)
    plain = train(Trainer(scene, plan, points), 12)
    rival = train(RivalTrainer(scene, plan, points, Rival()), 12)
    for one, other in zip(plain.model.parameters(), rival.model.parameters(), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("by", ["gradient", "distance"])
def test_the_penalty_lowers_opacities_the_more_the_higher_the_score(scene, points, by):
    config = replace(CONFIG, drop=0.0, recipe=Recipe(grad_threshold=1e9, prune_opacity=0.0))
    plan = make_plan(scene, config)
    without = train(Trainer(scene, plan, points), 15)
    penalised = train(RivalTrainer(scene, plan, points, Rival(opacity_l1=1.0, opacity_l1_by=by)), 15)
    fall = (without.model.opacity_logits.sigmoid() - penalised.model.opacity_logits.sigmoid()).detach()
    assert float(fall.mean()) > 0
    if by == "distance":
        cameras = [scene.train.camera(view) for view in range(3)]
        distances = [gaussian_scores("far", without.state.densifier, camera) for camera in cameras]
        order = torch.stack(distances).mean(0).argsort()
        assert float(fall[order[75:]].mean()) > float(fall[order[:75]].mean())
