"""What densification does to the state of optimisers, schedulers and checkpoints."""

import copy
import io

import pytest
import torch
from densifiers import LARGE, SMALL, seen, snapshot, train
from densifiers import densifier as make
from refusals import refused

from kgs import ArgumentError
from kgs.densify import Densifier, DensifyReport


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
