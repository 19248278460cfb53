"""Scores of Gaussians, the selections and the penalty by scores, and the fits that use them."""

import copy
import pickle
from dataclasses import replace

import pytest
import torch
from scipy import stats

from kgs.fit.config import FitConfig, Recipe
from kgs.fit.plan import make_plan
from kgs.fit.trainer import Trainer
from kgs.study.rivals import Rival, RivalTrainer, SelectiveDrop, gaussian_scores, opacity_l1

CONFIG = FitConfig(steps=40, drop=0.4, seed=2, evaluations=1, recipe=Recipe(grad_threshold=1e-5))


def train(trainer, steps):
    """Train until so many steps are done."""
    trainer.fit(lambda trainer, _: trainer.step == steps)
    return trainer


def test_distances_are_those_to_the_cameras_centre(scene, points):
    trainer = Trainer(scene, make_plan(scene, CONFIG, points), points)
    for view in range(3):
        camera = scene.train.camera(view)
        rotation, shift = camera.extrinsics[0, :3, :3], camera.extrinsics[0, :3, 3]
        in_camera = points.points @ rotation.T + shift
        far = gaussian_scores("far", trainer.state.densifier, camera)
        torch.testing.assert_close(far, in_camera.norm(dim=1), rtol=1e-5, atol=1e-5)
        assert torch.equal(gaussian_scores("near", trainer.state.densifier, camera), -far)


def test_gradients_are_means_of_what_the_densifier_observed(scene, points):
    config = replace(CONFIG, recipe=Recipe(grad_threshold=1e9))
    trainer = train(Trainer(scene, make_plan(scene, config, points), points), 9)  # before the first densification
    state = trainer.state.densifier.state_dict()
    expected = state["gradient_sums"] / (1 + state["counts"])
    assert float(expected.max()) > 0
    high = gaussian_scores("high-gradient", trainer.state.densifier, scene.train.camera(0))
    torch.testing.assert_close(high, expected)
    assert torch.equal(gaussian_scores("low-gradient", trainer.state.densifier, scene.train.camera(0)), -high)


@pytest.mark.parametrize("by", ["high-gradient", "low-gradient", "near", "far"])
def test_the_trainer_sets_the_scores_of_the_present_camera(scene, points, by):
    trainer = RivalTrainer(scene, make_plan(scene, CONFIG, points), points, Rival(drop_by=by))
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
    plan = make_plan(scene, CONFIG, points)
    plain = train(Trainer(scene, plan, points), 12)
    rival = train(RivalTrainer(scene, plan, points, Rival()), 12)
    for one, other in zip(plain.model.parameters(), rival.model.parameters(), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("by", ["gradient", "distance"])
def test_the_penalty_lowers_opacities_the_more_the_higher_the_score(scene, points, by):
    config = replace(CONFIG, drop=0.0, recipe=Recipe(grad_threshold=1e9, prune_opacity=0.0))
    plan = make_plan(scene, config, points)
    without = train(Trainer(scene, plan, points), 15)
    penalised = train(RivalTrainer(scene, plan, points, Rival(opacity_l1=1.0, opacity_l1_by=by)), 15)
    fall = (without.model.opacity_logits.sigmoid() - penalised.model.opacity_logits.sigmoid()).detach()
    assert float(fall.mean()) > 0
    if by == "distance":
        cameras = [scene.train.camera(view) for view in range(3)]
        distances = [gaussian_scores("far", without.state.densifier, camera) for camera in cameras]
        order = torch.stack(distances).mean(0).argsort()
        assert float(fall[order[75:]].mean()) > float(fall[order[:75]].mean())


# -- which Gaussians go when a selection replaces chance -------------------------------------------------------------


def layer(rate, scores):
    drop = SelectiveDrop(p=rate, schedule="constant")
    drop.scores = scores
    return drop


@pytest.mark.parametrize(
    ("rate", "scores", "expected"),
    [
        (0.2, [3.0, 9.0, 1.0, 7.0, 5.0], [1.25, 0.0, 1.25, 1.25, 1.25]),
        (0.4, [[3.0], [9.0], [1.0], [7.0], [5.0]], [[5 / 3], [0.0], [5 / 3], [0.0], [5 / 3]]),
        (0.25, [[1.0, 2.0, 3.0, 4.0], [4.0, 3.0, 2.0, 1.0]], [[4 / 3] * 3 + [0.0], [0.0] + [4 / 3] * 3]),
        (0.5, [0.0] * 6, [0.0] * 3 + [2.0] * 3),
    ],
    ids=["the highest", "a column", "a row for each camera", "equal ones in their order"],
)
def test_scores_choose_what_goes_and_the_rest_is_scaled(rate, scores, expected):
    drop, expected = layer(rate, torch.tensor(scores)), torch.tensor(expected)
    for _ in range(3):  # nothing is random
        x = torch.full(expected.shape, 0.7, requires_grad=True)
        out = drop(x)
        torch.testing.assert_close(out, 0.7 * expected)
        out.sum().backward()
        torch.testing.assert_close(x.grad, expected)


@pytest.mark.parametrize(("rate", "count"), [(0.0, 0), (0.004, 0), (0.2, 20), (0.999, 100)])
def test_the_number_is_the_rounded_share(rate, count):
    out = layer(rate, torch.randperm(100, generator=torch.Generator().manual_seed(0)).float())(torch.ones(100))
    assert int((out == 0).sum()) == count


def test_without_scores_chance_is_back_with_its_stream():
    plain, scored = (SelectiveDrop(p=0.5, schedule="constant", seed=3) for _ in range(2))
    scored.scores = torch.arange(1000.0)
    scored(torch.ones(1000))
    scored.scores = None
    out = scored(torch.ones(1000))
    assert torch.equal(out, plain(torch.ones(1000)))
    assert 0 < int((out[:500] == 0).sum()) < 500


def test_scores_are_copied_with_the_layer_and_are_in_no_state_dict():
    drop = layer(0.5, torch.arange(4.0))
    assert drop.state_dict() == {}
    for twin in (copy.deepcopy(drop), pickle.loads(pickle.dumps(drop))):
        assert twin(torch.ones(4)).tolist() == [2.0, 2.0, 0.0, 0.0]


# -- the L1 penalty on opacities --------------------------------------------------------------------------------------


def test_the_penalty_weighs_opacities_by_scipys_ranks():
    generator = torch.Generator().manual_seed(0)
    scores = torch.randint(0, 30, (200,), generator=generator).double().requires_grad_()
    opacities = torch.rand(200, generator=generator, dtype=torch.float64, requires_grad=True)
    weights = (torch.from_numpy(stats.rankdata(scores.detach().numpy())) - 0.5) / 200
    penalty = opacity_l1(opacities, scores)
    torch.testing.assert_close(penalty, (weights * opacities).mean(), rtol=1e-13, atol=0)
    penalty.backward()
    torch.testing.assert_close(opacities.grad, weights / 200, rtol=1e-13, atol=0)
    assert scores.grad is None
    assert float(opacity_l1(torch.empty(0), torch.empty(0))) == 0.0
