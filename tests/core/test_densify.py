"""Clone, split and prune: which Gaussians, how many, and where the children are."""

import copy
import dataclasses
import io
import math

import numpy as np
import pytest
import torch
from densifiers import LARGE, SMALL, seen, snapshot, train
from densifiers import densifier as make
from factories import random_model
from refusals import refused

from kgs import ArgumentError
from kgs.densify import Densifier, DensifyReport

NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh_dc", "sh_rest")


def test_a_small_gaussian_with_a_large_gradient_is_copied_exactly():
    model, _, densifier = make([SMALL] * 3)
    before = {name: parameter.detach().clone() for name, parameter in model.named_parameters()}
    densifier.observe(seen(model, [0, 1, 2], [(0, 0), (3e-4, 4e-4), (1e-4, 0)]))
    assert densifier.step() == DensifyReport(cloned=1, split=0, pruned=0, total=4, capped=0)
    for name, parameter in model.named_parameters():
        assert torch.equal(parameter[:3], before[name])
        assert torch.equal(parameter[3], before[name][1])


def test_a_large_gaussian_with_a_large_gradient_becomes_two_smaller_ones():
    model, _, densifier = make([SMALL, LARGE, LARGE])
    before = {name: parameter.detach().clone() for name, parameter in model.named_parameters()}
    densifier.observe(seen(model, [1], [(6e-4, 0)]))
    assert densifier.step() == DensifyReport(cloned=0, split=1, pruned=0, total=4, capped=0)
    assert torch.allclose(model.log_scales[2:].exp(), torch.tensor(LARGE / 1.6))
    for name in NAMES:
        parameter = getattr(model, name)
        assert torch.equal(parameter[:2], before[name][[0, 2]])  # the parent is gone
        if name not in ("means", "log_scales"):
            assert torch.equal(parameter[2:], before[name][[1, 1]])
    assert not torch.equal(model.means[2], model.means[3])
    assert not torch.equal(model.means[2], before["means"][1])


def test_children_are_drawn_from_their_parent():
    n = 4000
    model, _, densifier = make([1.0] * n, dtype=torch.float64)
    quat = torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=torch.float64)
    scales = torch.tensor([2.0, 1.0, 8.0], dtype=torch.float64)
    with torch.no_grad():
        model.means[:] = torch.tensor([5.0, -3.0, 1.0])
        model.quats[:] = 2.5 * quat
        model.log_scales[:] = scales.log()
    densifier.observe(seen(model, list(range(n)), [(1, 0)] * n))
    assert densifier.step().split == n
    spatial = pytest.importorskip("scipy.spatial.transform", reason="scipy is the oracle for rotations")
    rotation = torch.from_numpy(spatial.Rotation.from_quat(quat.numpy()[[1, 2, 3, 0]]).as_matrix().copy())
    local = (model.means.detach() - torch.tensor([5.0, -3.0, 1.0])) @ rotation / scales
    assert local.shape == (2 * n, 3)
    # standard normal coordinates: five standard errors of mean, variance and covariance
    assert local.mean(dim=0).abs().max() < 5 / math.sqrt(2 * n)
    assert (torch.cov(local.T) - torch.eye(3)).abs().max() < 5 * math.sqrt(2 / (2 * n))


def test_the_size_limit_itself_is_cloned_and_the_largest_axis_decides():
    model, _, densifier = make([1.0, 0.25, 0.25], extent=100.0, percent_dense=0.01)
    with torch.no_grad():
        model.log_scales[1, 2] = math.log(1.01)
    densifier.observe(seen(model, [0, 1], [(1, 0), (1, 0)]))
    report = densifier.step()
    assert (report.cloned, report.split) == (1, 1)


X = (1, 0)
BELOW = (math.nextafter(0.5, 0) - 1e-7, 0)
FAINT = 0.001
RULES = {  # scales, opacities, options, who was seen, with which gradients; cloned, split, pruned, total, capped
    "the threshold itself": ([SMALL] * 2, None, {"grad_threshold": 0.5}, [0, 1], [(0.5, 0), BELOW], (1, 0, 0, 3, 0)),
    "norms, not vectors": ([SMALL], None, {"grad_threshold": 0.9}, [0, 0], [X, (-1, 0)], (1, 0, 0, 2, 0)),
    "one without gradient is seen": ([SMALL], None, {"grad_threshold": 0.6}, [0, 0], [X, (0, 0)], (0, 0, 0, 1, 0)),
    "others do not count": ([SMALL] * 2, None, {"grad_threshold": 0.6}, [0], [X], (1, 0, 0, 3, 0)),
    "all at once": (
        [SMALL, SMALL, LARGE, LARGE, SMALL],
        [0.5, 0.5, 0.5, 0.5, FAINT],
        {},
        [0, 1, 2, 3],
        [X, (0, 0), X, (0, 0)],
        (1, 1, 1, 6, 0),
    ),
    "transparent ones go, whatever their gradient": (
        [SMALL, LARGE, SMALL, LARGE],
        [0.004, 0.004, 0.006, 0.004],
        {},
        [0, 1],
        [X, X],
        (0, 0, 3, 1, 0),
    ),
    "room made by pruning counts towards the cap, and a split adds one": (
        [LARGE, LARGE, LARGE, SMALL],
        [0.5, 0.5, 0.5, FAINT],
        {"max_gaussians": 5},
        [0, 1, 2],
        [X, (3, 0), (2, 0)],
        (0, 2, 1, 5, 1),
    ),
    "a model over the cap is not cut": ([SMALL] * 4, None, {"max_gaussians": 2}, [0], [X], (0, 0, 0, 4, 1)),
    "nothing is seen": ([SMALL] * 3, None, {}, [], [], (0, 0, 0, 3, 0)),
    "all may go": ([SMALL] * 2, [FAINT] * 2, {}, [], [], (0, 0, 2, 0, 0)),
}


@pytest.mark.parametrize("name", RULES)
def test_rules(name):
    scales, opacities, options, ids, gradients, expected = RULES[name]
    model, _, densifier = make(scales, opacities, **options)
    projected = seen(model, ids, gradients)
    if not ids:
        projected.means2d.grad = None  # as after a render that saw nothing
    densifier.observe(projected)
    assert densifier.step() == DensifyReport(*expected)
    assert {len(parameter) for parameter in model.parameters()} == {expected[3]}
    assert densifier.step() == DensifyReport(0, 0, 0, expected[3], 0), "statistics begin anew"


def test_gradients_are_in_normalised_device_coordinates():
    # W = 40, H = 6: one pixel is 20 along x and 3 along y
    model, _, densifier = make([SMALL] * 4, grad_threshold=60.0)
    means = model.means.detach().clone()
    densifier.observe(seen(model, [0, 1, 2, 3], [(3, 0), (2.9, 0), (0, 20), (0, 19.9)], image_size=(6, 40)))
    densifier.step()
    assert torch.equal(model.means[4:], means[[0, 2]])


def test_the_mean_over_cameras_is_undone():
    model, _, densifier = make([SMALL] * 2, grad_threshold=0.9)
    # 0 is seen by two of four cameras (each gradient carries a factor 1/4), 1 by one
    projected = seen(
        model, [0, 1, 0], [(0.25, 0), (0.2, 0), (0, 0.25)], num_cameras=4, camera_ids=torch.tensor([0, 0, 3])
    )
    densifier.observe(projected)
    assert densifier.state_dict()["gradient_sums"].tolist() == pytest.approx([2.0, 0.8])
    assert densifier.state_dict()["counts"].tolist() == [2, 1]
    assert densifier.step().cloned == 1


def test_the_cap_takes_the_largest_gradients_and_ties_by_position():
    model, _, densifier = make([SMALL] * 6, max_gaussians=9)
    means = model.means.detach().clone()
    densifier.observe(seen(model, [0, 1, 2, 3, 4], [(1, 0), (3, 0), (1, 0), (2, 0), (1, 0)]))
    assert densifier.step() == DensifyReport(cloned=3, split=0, pruned=0, total=9, capped=2)
    assert torch.equal(model.means[6:], means[[0, 1, 3]])


@pytest.mark.filterwarnings("error")  # torch's warning about .grad would hide the message
def test_a_forgotten_retain_grad_is_one_error_and_no_warning():
    model, _, densifier = make([SMALL])
    projected = seen(model, [0], [(0, 0)])
    projected = dataclasses.replace(projected, means2d=projected.means2d.detach().requires_grad_() * 1.0)
    with pytest.raises(ValueError, match="retain_grad"):
        densifier.observe(projected)


@pytest.mark.parametrize("log_scale", [-100.0, -44.0, 44.0, 88.0, 89.0, 1000.0])
def test_extreme_scales_and_opacities_stay_finite(log_scale):
    model, _, densifier = make([SMALL] * 3)
    with torch.no_grad():
        model.log_scales[:] = log_scale
        model.opacity_logits[:] = torch.tensor([17.0, 1e4, 104.0])
    densifier.observe(seen(model, [0, 1, 2], [(1, 0)] * 3))
    assert densifier.step().total == 6
    assert all(bool(torch.isfinite(parameter).all()) for parameter in model.parameters())


# -- the mean gradients that scores are made of --------------------------------------------------------------------


def test_mean_gradients_go_on_through_a_step_and_children_inherit_them():
    model, _, densifier = make([SMALL, LARGE, SMALL, SMALL], opacities=[0.5, 0.5, 0.5, 1e-4], grad_threshold=0.5)
    assert densifier.mean_gradients.tolist() == [0.0, 0.0, 0.0, 0.0]
    densifier.observe(seen(model, [0, 1, 2, 3], [[0.8, 0.0], [0.9, 0.0], [0.1, 0.0], [0.7, 0.0]]))
    densifier.observe(seen(model, [0, 1], [[0.8, 0.0], [0.9, 0.0]]))
    assert densifier.mean_gradients.tolist() == pytest.approx([1.6 / 3, 1.8 / 3, 0.1 / 2, 0.7 / 2])
    report = densifier.step()
    assert (report.cloned, report.split, report.pruned) == (1, 1, 1)
    # kept: 0 and 2; born: the clone of 0, two children of 1; the transparent one is gone
    assert densifier.mean_gradients.tolist() == pytest.approx([1.6 / 3, 0.1 / 2, 1.6 / 3, 1.8 / 3, 1.8 / 3])
    densifier.observe(seen(model, [1], [[0.4, 0.0]]))
    assert densifier.mean_gradients.tolist() == pytest.approx([1.6 / 3, 0.45 / 2, 1.6 / 3, 1.8 / 3, 1.8 / 3])


# -- decay ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [None, torch.arange(50) % 3 == 0], ids=["all", "some rows"])
def test_decay_multiplies_opacities_in_place_and_leaves_others_their_bits(rows):
    model = random_model(50, 0)
    with torch.no_grad():
        model.opacity_logits[:4] = torch.tensor([30.0, -30.0, math.inf, -math.inf])
    before = model.opacity_logits.detach().clone()
    parameter = model.opacity_logits
    Densifier(model, torch.optim.Adam(model.parameters()), 1.0).decay_opacity(0.99, rows)
    assert model.opacity_logits is parameter
    rows = torch.ones(50, dtype=torch.bool) if rows is None else rows
    assert torch.equal(parameter[~rows], before[~rows])
    decayed = parameter[rows].detach().double().sigmoid()
    np.testing.assert_allclose(decayed, 0.99 * before[rows].double().sigmoid(), rtol=2e-6)


def test_a_model_without_gaussians_goes_through_everything():
    model, _, densifier = make([SMALL], [0.001])
    densifier.step()
    assert model().colors.shape == (0, 9, 3)
    densifier.decay_opacity(0.99)
    densifier.reset_opacity()
    assert densifier.step().total == 0


# -- optimizers ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_survivors_keep_their_moments_bit_for_bit_and_new_rows_have_none(dtype):
    scales = [SMALL, LARGE, SMALL, LARGE, SMALL]
    model, adam, densifier = make(scales, [0.5, 0.5, 0.001, 0.5, 0.5], dtype=dtype)
    for _ in range(3):
        train(model, adam)
    before = snapshot(model, adam)
    densifier.observe(seen(model, [0, 1, 4], [(1, 0), (1, 0), (0, 0)]))
    assert densifier.step() == DensifyReport(cloned=1, split=1, pruned=1, total=6, capped=0)
    survivors = torch.tensor([0, 3, 4])
    for name, parameter in model.named_parameters():
        state = adam.state[parameter]
        old_value, old_state = before[name]
        assert torch.equal(parameter[:3], old_value[survivors])
        assert state["step"].item() == 3
        for moment in ("exp_avg", "exp_avg_sq"):
            assert state[moment].shape == parameter.shape
            assert bool(old_state[moment][survivors].any())
            assert torch.equal(state[moment][:3], old_state[moment][survivors])
            assert not state[moment][3:].any()


@pytest.mark.parametrize("optimizer", [torch.optim.Adam, torch.optim.SGD])
def test_without_state_and_with_an_old_graph_training_goes_on(optimizer):
    model, made, densifier = make([SMALL, LARGE], optimizer=optimizer)
    alive = model()
    densifier.observe(seen(model, [0, 1], [(1, 0), (1, 0)]))
    assert densifier.step().total == 4
    densifier.reset_opacity()
    train(model, made)
    assert (len(model), len(alive)) == (4, 2)


def test_foreign_parameters_are_left_alone_and_frozen_ones_stay_frozen():
    model, _, _ = make([SMALL, LARGE])
    model.quats.requires_grad_(False)
    pose = torch.nn.Parameter(torch.ones(2, 3))
    adam = torch.optim.Adam([pose, *model.parameters()])
    densifier = Densifier(model, adam, 100.0)
    (pose.sum() + model.means.sum()).backward()
    adam.step()
    moment = adam.state[pose]["exp_avg"].clone()
    densifier.observe(seen(model, [0], [(1, 0)]))
    densifier.step()
    assert adam.param_groups[0]["params"][0] is pose
    assert torch.equal(adam.state[pose]["exp_avg"], moment)
    assert {id(p) for p in adam.param_groups[0]["params"][1:]} == {id(p) for p in model.parameters()}
    assert [name for name, p in model.named_parameters() if not p.requires_grad] == ["quats"]


@pytest.mark.parametrize("rows", [2, 3, 200])
def test_parameters_that_are_not_of_gaussians_stay_as_they_are(rows):
    model, _, _ = make([SMALL, LARGE])
    model.network = torch.nn.Linear(5, rows)
    adam = torch.optim.Adam(model.parameters())
    densifier = Densifier(model, adam, 100.0)
    before = {name: value.clone() for name, value in model.network.named_parameters()}
    densifier.observe(seen(model, [0, 1], [(1, 0), (1, 0)]))
    assert densifier.step().total == 4
    assert {name: tuple(value.shape) for name, value in model.per_gaussian().items()}["means"] == (4, 3)
    for name, value in model.network.named_parameters():
        assert torch.equal(value, before[name])
        assert any(value is held for held in adam.param_groups[0]["params"])


def test_opacity_reset_lowers_only_what_is_above_and_zeroes_only_its_moments():
    model, adam, densifier = make([SMALL] * 3, [0.9, 0.006, 0.5])
    for _ in range(2):
        train(model, adam)
    before = snapshot(model, adam)
    densifier.reset_opacity()
    opacities = model().opacities
    assert opacities[[0, 2]].tolist() == pytest.approx([0.01, 0.01], rel=1e-5)
    assert model.opacity_logits[1] == before["opacity_logits"][0][1]
    for name, parameter in model.named_parameters():
        state = adam.state[parameter]
        assert state["step"].item() == 2
        for moment in ("exp_avg", "exp_avg_sq"):
            expected = before[name][1][moment]
            assert torch.equal(state[moment], torch.zeros(3) if name == "opacity_logits" else expected)
    train(model, adam)
    assert adam.state[model.opacity_logits]["step"].item() == 3


def test_opacity_reset_twice_is_once_and_stands_saturated_logits():
    model, _, densifier = make([SMALL] * 4)
    with torch.no_grad():
        model.opacity_logits[:] = torch.tensor([1e4, 17.0, -17.0, -1e4])
    densifier.reset_opacity()
    once = model.opacity_logits.detach().clone()
    densifier.reset_opacity()
    assert bool(torch.isfinite(once).all())
    assert torch.equal(model.opacity_logits, once)
    assert once[2:].tolist() == [-17.0, -1e4]


def test_the_same_seed_gives_the_same_children_whatever_the_default_generator_does():
    results = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        model, _, densifier = make([LARGE] * 3, generator=torch.Generator().manual_seed(5))
        state = torch.get_rng_state()
        densifier.observe(seen(model, [0, 1, 2], [(1, 0)] * 3))
        densifier.step()
        assert torch.equal(torch.get_rng_state(), state)
        results.append(model.means.detach().clone())
    assert torch.equal(*results)


KINDS = {
    "Adam": torch.optim.Adam,
    "fused": lambda *args, **kwargs: torch.optim.Adam(*args, fused=True, **kwargs),
    "foreach": lambda *args, **kwargs: torch.optim.Adam(*args, foreach=True, **kwargs),
    "amsgrad": lambda *args, **kwargs: torch.optim.AdamW(*args, amsgrad=True, **kwargs),
    "momentum": lambda *args, **kwargs: torch.optim.SGD(*args, momentum=0.9, **kwargs),
    **{name: getattr(torch.optim, name) for name in ("Adadelta", "Adagrad", "Adamax", "ASGD", "NAdam", "RAdam")},
    "RMSprop": lambda *args, **kwargs: torch.optim.RMSprop(*args, centered=True, momentum=0.5, **kwargs),
}


@pytest.mark.parametrize("kind", KINDS)
def test_state_follows_the_gaussians_in_optimizers_of_every_kind_with_a_schedule(kind):
    def fit(densify):
        model, optimizer, densifier = make([SMALL, SMALL, LARGE], [0.5, 0.5, 0.001], optimizer=KINDS[kind])
        schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.5)
        for step in range(4):
            train(model, optimizer)
            schedule.step()
            if densify and step == 1:
                densifier.observe(seen(model, [0], [(1, 0)]))
                assert densifier.step() == DensifyReport(cloned=1, split=0, pruned=1, total=3, capped=0)
        state = optimizer.state_dict()
        optimizer.load_state_dict(copy.deepcopy(state))
        assert {group["lr"] for group in optimizer.param_groups} == {0.01 * 0.5**4}
        return model, optimizer

    def train(model, optimizer):  # the same gradient for each Gaussian
        optimizer.zero_grad()
        sum((p * torch.arange(1.0, p[:1].numel() + 1).view_as(p[:1])).sum() for p in model.parameters()).backward()
        optimizer.step()

    (one, optimizer), (other, _) = fit(True), fit(False)
    for name, parameter in one.named_parameters():
        assert torch.equal(parameter[:2], other.get_parameter(name)[:2])
        for entry in optimizer.state[parameter].values():
            assert not isinstance(entry, torch.Tensor) or entry.shape in ((), (1,), parameter.shape)


def test_an_unknown_state_is_refused_before_anything_is_changed():
    class Factored(torch.optim.SGD):
        def step(self):
            for group in self.param_groups:
                for parameter in group["params"]:
                    self.state[parameter]["column"] = torch.zeros(1, *parameter.shape[1:])

    model, optimizer, densifier = make([SMALL] * 3, optimizer=Factored)
    optimizer.step()
    held = dict(model.named_parameters())
    for call in (densifier.step, densifier.reset_opacity, lambda: Densifier(model, optimizer, 1.0)):
        with pytest.raises(ValueError, match=r"the state column of means to have shape \(3, 3\), got \(1, 3\)"):
            call()
    assert all(parameter is held[name] for name, parameter in model.named_parameters())


def test_a_model_and_its_densifier_take_over_saved_states_of_another_size():
    model, adam, densifier = make([SMALL, LARGE, SMALL])
    train(model, adam)
    densifier.observe(seen(model, [1], [(1, 0)]))
    file = io.BytesIO()
    torch.save([x.state_dict() for x in (model, adam, densifier)], file)
    file.seek(0)
    states = torch.load(file, weights_only=True)
    resumed = make([SMALL])
    resumed[0].load_state_dict(states[0])
    with refused(ArgumentError, name="model"):
        resumed[2].step()
    for part, state in zip(resumed, states, strict=True):
        part.load_state_dict(state)
    assert densifier.step() == resumed[2].step()
    for one, two in ((model, adam), resumed[:2]):
        train(one, two)
    assert all(torch.equal(a, b) for a, b in zip(model.parameters(), resumed[0].parameters(), strict=True))
