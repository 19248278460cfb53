"""What a fit does with gradients, by Triton's kernels: Adam, statistics of densification, decay of opacities."""

import math

import pytest
import torch
from densifiers import seen
from factories import random_model
from targets import TRITON, Target

from kgs import Densifier
from kgs.fit.adam import Adam

pytestmark = TRITON
SHAPES = {"means": (401, 3), "bands": (401, 15, 3), "none": (2, 2), "opacities": (401,), "empty": (0, 3)}
SHAPES |= {"dc": (401, 1, 3), "scales": (401, 3), "quats": (401, 4), "late": (7,)}


def make_adam(kernels, shapes=SHAPES):
    """Adam with random parameters on the device; a learning rate for each."""
    generator = torch.Generator().manual_seed(0)
    groups = []
    for k, (name, shape) in enumerate(shapes.items()):
        parameter = kernels.move(torch.randn(shape, generator=generator)).requires_grad_()
        groups.append({"params": [parameter], "name": name, "lr": 0.01 * (k + 1)})
    return Adam(groups, eps=1e-15, backend=kernels.backend)


def train(adam, steps, seed=1):
    """Some steps with gradients from 1 to 1e-10, of `none` never, of `late` from the third step on."""
    generator = torch.Generator().manual_seed(seed)
    for step in range(steps):
        for group in adam.param_groups:
            [parameter] = group["params"]
            gradient = torch.randn(parameter.shape, generator=generator) * 10.0 ** (-2 * step)
            missing = group["name"] == "none" or (group["name"] == "late" and step < 2)
            parameter.grad = None if missing else gradient.to(parameter)
            group["lr"] *= 0.9
        adam.step()


def assert_same(one, other):
    """Parameters and moments of two optimizers, within the rounding of float32."""
    for first, second in zip(one.param_groups, other.param_groups, strict=True):
        torch.testing.assert_close(first["params"][0].cpu(), second["params"][0].cpu(), rtol=1e-6, atol=1e-6)
    states = [adam.state_dict() for adam in (one, other)]
    assert states[0].keys() == states[1].keys()
    for name, state in states[0].items():
        assert state.keys() == states[1][name].keys()
        for key, value in state.items():
            assert (value.dtype, value.shape) == (states[1][name][key].dtype, states[1][name][key].shape)
            torch.testing.assert_close(value.cpu(), states[1][name][key].cpu(), rtol=1e-5, atol=1e-8)


def test_adam_is_that_of_torch(kernels):
    ours, torchs = make_adam(kernels), make_adam(Target("torch"))
    for adam in (ours, torchs):
        train(adam, 6)
    assert_same(ours, torchs)
    assert torchs.state_dict()["none"] == {}
    assert float(ours.state_dict()["late"]["step"]) == 4.0


def test_a_state_of_adam_goes_from_one_backend_to_another(kernels):
    shapes = {"means": (33, 3), "opacities": (33,)}
    for first, second in ((kernels, Target("torch")), (Target("torch"), kernels)):
        begun, went_on, other = make_adam(first, shapes), make_adam(first, shapes), make_adam(second, shapes)
        train(begun, 2)
        for adam in (went_on, other):
            for group, from_group in zip(adam.param_groups, begun.param_groups, strict=True):
                group["params"][0].data.copy_(from_group["params"][0].data)
            adam.load_state_dict(begun.state_dict())
            train(adam, 2, seed=2)
        assert_same(went_on, other)


def test_gradients_and_parameters_may_lie_in_any_order_in_memory(kernels):
    usual, other = make_adam(kernels, {"x": (40, 3)}), make_adam(kernels, {"x": (40, 3)})
    by_columns = make_adam(kernels, {"x": (40, 3)})
    [parameter] = by_columns.param_groups[0]["params"]
    parameter.data = parameter.data.t().contiguous().t()
    gradient = kernels.move(torch.arange(120.0).sin().view(40, 3))
    for adam, like in ((usual, gradient), (other, gradient.t().contiguous().t()), (by_columns, parameter)):
        adam.param_groups[0]["params"][0].grad = torch.empty_like(like).copy_(gradient)
        for _ in range(2):
            adam.step()
        assert_same(adam, usual)


def test_autograd_knows_that_parameters_changed(kernels):
    adam = make_adam(kernels, {"x": (5,)})
    [x] = adam.param_groups[0]["params"]
    loss = x.square().sum()
    loss.backward(retain_graph=True)
    adam.step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


# -- densification -------------------------------------------------------------------------------------------------


def both_densifiers(kernels, count):
    """Of the same model: one by the kernels, one by torch."""
    for target in (kernels, Target("torch")):
        model = random_model(count, 0).to(target.device)
        yield target, Densifier(model, torch.optim.SGD(model.parameters()), 1.0, backend=target.backend)


@pytest.mark.parametrize("count", [300, 1, 0])
def test_statistics_are_those_of_torch(kernels, count):
    generator = torch.Generator().manual_seed(0)
    ids = torch.randperm(count, generator=generator)[: 2 * count // 3 + 1]
    gradients = torch.randn(len(ids), 2, generator=generator) * 10.0 ** torch.linspace(-30, 18, len(ids))[:, None]
    gradients[::7, 0] = 0.0
    gradients[::14] = 0.0
    found = []
    for target, densifier in both_densifiers(kernels, count):
        for _ in range(2):
            render = target.move(seen(densifier.model, ids.tolist(), gradients.tolist(), (30, 50)))
            render.means2d.requires_grad_().grad = target.move(gradients.t().contiguous().t())
            densifier.observe(render)
        found.append({name: value.cpu() for name, value in densifier.state_dict().items()})
    ours, torchs = found
    assert torch.equal(ours["counts"], torchs["counts"])
    torch.testing.assert_close(ours["gradient_sums"], torchs["gradient_sums"], rtol=1e-6, atol=1e-37)


def test_a_gradient_that_is_not_a_number_stays_one(kernels):
    gradients = [[math.nan, 1.0], [1.0, math.nan], [math.inf, 0.0], [math.inf, math.inf], [3.0, -4.0]]
    _, densifier = next(both_densifiers(kernels, 5))
    render = kernels.move(seen(densifier.model, list(range(5)), gradients, (2, 2)))
    render.means2d.requires_grad_().grad = kernels.move(torch.tensor(gradients))
    densifier.observe(render)
    sums = densifier.state_dict()["gradient_sums"].tolist()
    assert sums == pytest.approx([math.nan, math.nan, math.inf, math.inf, 5.0], nan_ok=True)


def test_several_cameras_see_a_gaussian_several_times(kernels):
    found = []
    for target, densifier in both_densifiers(kernels, 3):
        changes = {"num_cameras": 2, "camera_ids": torch.tensor([0, 0, 1])}
        render = target.move(seen(densifier.model, [0, 1, 1], [[3.0, 4.0]] * 3, (2, 2), **changes))
        render.means2d.requires_grad_().grad = torch.tensor([[3.0, 4.0]] * 3).to(target.device)
        densifier.observe(render)
        found.append(densifier.mean_gradients.tolist())
    assert found[0] == pytest.approx(found[1])
    assert found[1] == pytest.approx([5.0, 20 / 3, 0.0])


@pytest.mark.parametrize(("factor", "count"), [(0.995, 300), (0.5, 300), (1e-3, 300), (0.5, 0)])
def test_opacities_decay_as_by_torch(kernels, factor, count):
    found = []
    for target, densifier in both_densifiers(kernels, count):
        logits = densifier.model.opacity_logits
        special = torch.tensor([30.0, -30.0, math.inf, -math.inf, math.nan, 0.0, 5.3, 17.0, -88.0, 1e30])
        with torch.no_grad():
            logits[:10] = target.move(special)[:count]
        version = logits._version
        densifier.decay_opacity(factor)
        assert logits._version > version
        densifier.decay_opacity(factor, torch.arange(count) % 3 == 0)  # some rows
        found.append(logits.detach().cpu())
    torch.testing.assert_close(*found, rtol=1e-6, atol=1e-6, equal_nan=True)
