"""Activations of the kernels against torch's in float64: values, gradients, and what overflows."""

import copy
import math

import pytest
import torch

import kgs

OUTPUTS = ("scales", "opacities", "colors")


def make_model(n=300, highest=3, degree=3):
    generator = torch.Generator().manual_seed(n)

    def numbers(*shape):
        return torch.randn(shape, generator=generator)

    return kgs.GaussianModel(
        means=numbers(n, 3),
        quats=numbers(n, 4),
        log_scales=numbers(n, 3) * 4 - 3,
        opacity_logits=numbers(n) * 5,
        sh_dc=numbers(n, 1, 3),
        sh_rest=numbers(n, (highest + 1) ** 2 - 1, 3),
        sh_degree=degree,
    )


def outputs_and_gradients(model, backend, names=OUTPUTS):
    """Scales, opacities and colours, and the gradients of all parameters by those that are named."""
    gaussians = model(backend=backend)
    for seed, name in enumerate(names):
        output = getattr(gaussians, name)
        weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(seed)).to(output)
        if output.requires_grad:
            output.backward(weights, retain_graph=True)
    return [getattr(gaussians, name).detach() for name in OUTPUTS], [x.grad for x in model.parameters()]


def assert_alike(model, names=OUTPUTS):
    exact = copy.deepcopy(model).double()
    found, gradients = outputs_and_gradients(model, "triton", names)
    expected, right = outputs_and_gradients(exact, "torch", names)
    assert [x is None for x in gradients] == [x is None for x in right]
    pairs = zip((*found, *gradients), (*expected, *right), strict=True)
    for value, double in [pair for pair in pairs if pair[0] is not None]:
        assert value.is_contiguous()
        lost = 2e-7 if value is gradients[3] else 1e-37  # 1 - opacity, where that is nearly 1
        torch.testing.assert_close(value, double.float(), rtol=5e-7, atol=lost)


@pytest.mark.parametrize(("highest", "degree"), [(3, 3), (3, 1), (2, 2), (1, 0), (0, 0)])
def test_values_and_gradients_of_every_degree(highest, degree):
    assert_alike(make_model(highest=highest, degree=degree))


@pytest.mark.parametrize("n", [0, 1, 257])
def test_any_number_of_gaussians(n):
    assert_alike(make_model(n, highest=1, degree=1))


def test_scales_that_overflow_and_opacities_of_0_and_1():
    model = make_model(8, highest=0, degree=0)
    edge = torch.tensor(math.log(torch.finfo(torch.float32).max))
    with torch.no_grad():
        model.log_scales[0] = torch.tensor([100.0, -math.inf, math.inf])
        model.log_scales[1] = torch.stack([edge, edge.nextafter(torch.tensor(0.0)), edge + 1])
        model.log_scales[2] = torch.tensor([-87.0, -200.0, 88.7])
        model.opacity_logits[:4] = torch.tensor([math.inf, -math.inf, 200.0, -200.0])
    weights = torch.rand(8, 3)
    found = []
    for backend in ("triton", "torch"):
        gaussians = model(backend=backend)
        outputs, inputs = (gaussians.scales, gaussians.opacities), (model.log_scales, model.opacity_logits)
        found.append((*outputs, *torch.autograd.grad(outputs, inputs, (weights, weights[:, 0]))))
    torch.testing.assert_close(*found, rtol=2e-6, atol=1e-37)
    assert not found[0][2][0].any()


def test_what_is_not_a_number_stays():
    model = make_model(8, highest=0, degree=0)
    with torch.no_grad():
        model.log_scales[3, 1] = math.nan
        model.opacity_logits[5] = math.nan
    gaussians = model(backend="triton")
    assert gaussians.scales.isnan().nonzero().tolist() == [[3, 1]]
    assert gaussians.opacities.isnan().nonzero().tolist() == [[5]]


@pytest.mark.parametrize("names", [("scales",), ("opacities",), ("colors",), ("scales", "colors")])
def test_gradients_by_some_of_the_outputs(names):
    assert_alike(make_model(40), names)


@pytest.mark.parametrize("frozen", ["log_scales", "opacity_logits", "sh_dc", "sh_rest"])
def test_a_parameter_that_is_frozen_has_no_gradient(frozen):
    model = make_model(40)
    model.get_parameter(frozen).requires_grad_(False)
    assert_alike(model)


def test_parameters_that_do_not_lie_in_a_row():
    model = make_model(40)
    for parameter in model.parameters():
        parameter.data = parameter.data.transpose(0, -1).contiguous().transpose(0, -1)
    found, gradients = outputs_and_gradients(model, "triton")
    expected, right = outputs_and_gradients(copy.deepcopy(model), "torch")
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-37)
    torch.testing.assert_close(gradients[2:], right[2:], rtol=1e-6, atol=1e-37)


def test_there_is_no_second_derivative():
    model = make_model(8)
    with pytest.raises(RuntimeError, match="model: expected backward without create_graph"):
        torch.autograd.grad(model(backend="triton").scales.sum(), model.log_scales, create_graph=True)


def test_another_dtype_is_refused_by_name():
    with pytest.raises(ValueError, match="for this call of activation, got 'triton'"):
        make_model(8).double()(backend="triton")
