"""Adam against torch's, and what it does not load."""

import pytest
import torch

from kgs.fit.adam import Adam


def groups(dtype):
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (2001, 3), "opacities": (2001,), "none": (2, 2)}
    values = {name: torch.randn(shape, generator=generator, dtype=dtype) for name, shape in shapes.items()}
    return [{"params": [value.requires_grad_()], "name": name, "lr": 0.01} for name, value in values.items()]


def train(optimizer, steps, seed):
    generator = torch.Generator().manual_seed(seed)
    for step in range(steps):
        for group in optimizer.param_groups[:2]:
            [parameter] = group["params"]
            parameter.grad = torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype) * 10.0**-step
            group["lr"] *= 0.9
        if step == 2:
            parameter.grad = None
        optimizer.step()


def state_of(optimizer):
    return {group["name"]: optimizer.state.get(group["params"][0], {}) for group in optimizer.param_groups}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_parameters_and_moments_are_those_of_torch_bit_for_bit(dtype):
    ours, theirs = Adam(groups(dtype), eps=1e-15), torch.optim.Adam(groups(dtype), eps=1e-15, fused=True)
    for optimizer in (ours, theirs):
        train(optimizer, 6, 1)
    ours.zero_grad()
    assert all(group["params"][0].grad is None for group in ours.param_groups)
    for one, other in zip(ours.param_groups, theirs.param_groups, strict=True):
        assert torch.equal(one["params"][0], other["params"][0])
    ours_state, theirs_state = ours.state_dict(), state_of(theirs)
    assert ours_state["none"] == {}
    for name in ("means", "opacities"):
        assert ours_state[name].keys() == theirs_state[name].keys()
        assert all(torch.equal(value, theirs_state[name][key]) for key, value in ours_state[name].items())


def test_a_state_that_was_loaded_does_not_change_with_the_steps():
    adam, other = Adam(groups(torch.float32)), Adam(groups(torch.float32))
    train(adam, 2, 1)
    state = adam.state_dict()
    before = {key: value.clone() for key, value in state["means"].items()}
    other.load_state_dict(state)
    train(other, 2, 2)
    assert all(torch.equal(value, before[key]) for key, value in state["means"].items())
