"""Blending with a background of the kernels against torch's in float64."""

import math

import pytest
import torch

from kgs.backends.gpu.blending import blend
from kgs.backends.torch.blending import blend as blend_in_torch

SIZE = (13, 31)


def image_and_gradients(stage, dtype, background, channels, count):
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(count, channels, *SIZE, generator=generator)
    transmittance = torch.rand(count, 1, *SIZE, generator=generator)
    transmittance[:, :, 3:6] = 0.0
    weights = torch.rand(count, channels, *SIZE, generator=generator)
    leaves = [x.to(dtype).requires_grad_() for x in (image, transmittance)]
    found = stage(*leaves, background.to(dtype))
    return found.detach(), *torch.autograd.grad(found, leaves, weights.to(dtype))


def assert_alike(background, channels, count):
    found = image_and_gradients(blend, torch.float32, background, channels, count)
    expected = image_and_gradients(blend_in_torch, torch.float64, background, channels, count)
    torch.testing.assert_close(found, tuple(x.float() for x in expected), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(("channels", "count"), [(3, 1), (3, 2), (1, 1), (7, 2)])
def test_one_color(channels, count):
    assert_alike(torch.linspace(-1, 2, channels)[:, None, None], channels, count)


@pytest.mark.parametrize(("channels", "count"), [(3, 1), (4, 3)])
def test_a_color_for_each_image(channels, count):
    assert_alike(torch.rand(count, channels, 1, 1), channels, count)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 3, 1, 1), (2, 1, 1, 1), (1, 1)])
def test_a_background_that_is_expanded(shape):
    assert_alike(torch.full(shape, 0.7), 3, 2)


def test_other_backgrounds_and_their_gradient_by_torch():
    assert_alike(torch.rand(3, *SIZE), 3, 2)
    color = torch.rand(3, 1, 1, requires_grad=True)
    blend(torch.rand(1, 3, *SIZE), torch.rand(1, 1, *SIZE), color).sum().backward()
    assert color.grad.all()


def test_an_infinite_color_shows_only_where_light_is_left():
    color = torch.tensor([math.inf, 0.5, -math.inf])[:, None, None]
    image, by_image, by_transmittance = image_and_gradients(blend, torch.float32, color, 3, 1)
    expected = image_and_gradients(blend_in_torch, torch.float32, color, 3, 1)
    assert torch.equal(image, expected[0])
    assert torch.equal(by_image, expected[1])
    dark = slice(3, 6)
    assert image[:, :, dark].isfinite().all()
    torch.testing.assert_close(by_transmittance[:, :, dark], expected[2][:, :, dark])


def test_a_frozen_transmittance_and_no_second_derivative():
    image, transmittance = torch.rand(1, 3, *SIZE, requires_grad=True), torch.rand(1, 1, *SIZE)
    found = blend(image, transmittance, torch.rand(3, 1, 1))
    assert torch.equal(torch.autograd.grad(found.sum(), image, retain_graph=True)[0], torch.ones_like(image))
    with pytest.raises(RuntimeError, match="background: expected backward without create_graph"):
        torch.autograd.grad(found.sum(), image, create_graph=True)
