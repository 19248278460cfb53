"""The dense reference against 50 digits, by hand where a limit or a sum is known."""

import itertools

import pytest
import torch
from factories import pinhole, random_camera, random_gaussians, replace
from oracles import mpmath_pixels
from reference_checks import EXACT, RED, SMALL, stack, tensor

from kgs import Gaussians
from kgs.reference import layers, render


def test_weights_and_transmittance_are_a_partition_of_unity():
    drawn = layers(random_gaussians(80, 0), random_camera(12, 14, 0), **EXACT)
    assert float((drawn.weights.sum(0) + drawn.transmittance - 1).abs().max()) < 1e-14
    gaussians = random_gaussians(80, 0, sh_degree=None)
    grey = replace(gaussians, colors=torch.full_like(gaussians.colors, 0.7))
    camera = random_camera(12, 14, 0)
    image = render(grey, camera, torch.full((3,), 0.7, dtype=torch.float64), **EXACT)
    assert float((image - 0.7).abs().max()) < 1e-14


@pytest.mark.parametrize("form", [(3,), (1, 3), (1, 3, 4, 5)])
def test_background_forms(form):
    color = tensor(0.2, 0.4, 0.6)
    background = color[None, :, None, None].expand(1, 3, 4, 5) if len(form) == 4 else color.reshape(form)
    image = render(stack([0.25], [RED], scale=1e9), SMALL, background, **EXACT)
    torch.testing.assert_close(image[0, :, 2, 3], tensor(0.4, 0.3, 0.45), rtol=0, atol=1e-12)


@pytest.mark.parametrize("thresholds", [(0.0, 0.0), (1 / 255, 1e-4), (1 / 32, 0.2)])
@pytest.mark.parametrize("sh_degree", [None, 3])
def test_fifty_digits(sh_degree, thresholds):
    gaussians = random_gaussians(15, 3, sh_degree=sh_degree)
    gaussians = replace(gaussians, opacities=gaussians.opacities * 1.25)
    camera = random_camera(24, 32, 4)
    camera.intrinsics[0, 0, 1] = 2.5  # skew
    pixels = [(0, 0), (5, 7), (12, 20), (23, 31), (14, 11)]
    expected = tensor(*mpmath_pixels(gaussians, camera, pixels, (0.1, 0.2, 0.3), *thresholds))
    image = render(gaussians, camera, tensor(0.1, 0.2, 0.3), *thresholds)[0]
    actual = torch.stack([image[:, row, column] for row, column in pixels])
    assert float((actual - expected).abs().max()) < 1e-13
    if thresholds == (0.0, 0.0):
        assert float((expected - tensor(0.1, 0.2, 0.3)).abs().amax(1).min()) > 1e-3  # every pixel shows something


def test_fifty_digits_beyond_the_tangent_limits():
    camera = pinhole(16, 16, 20, centre=(5.0, 9.0))
    limit = (16 - 0.5 - 5.0 + 0.15 * 16) / 20
    gaussians = random_gaussians(4, 0, sh_degree=None)
    tangents = tensor([0.99 * limit, 0.1], [1.01 * limit, -0.2], [3 * limit, 0.0], [-2.0, 2.0])
    gaussians = replace(
        gaussians,
        means=torch.cat([2 * tangents, torch.full((4, 1), 2.0)], 1),
        scales=torch.full((4, 3), 0.5).double() * tensor(1.0, 0.6, 0.8),
    )
    pixels = list(itertools.product((0, 7, 15), (0, 7, 15)))
    image = render(gaussians, camera, **EXACT)[0]
    expected = tensor(*mpmath_pixels(gaussians, camera, pixels))
    assert float(expected.max()) > 0.1
    assert float((torch.stack([image[:, r, c] for r, c in pixels]) - expected).abs().max()) < 1e-13


def test_negative_colours_become_black_and_pass_no_gradient():
    colors = tensor([[0.0] * 3], [[-5.0, 0.0, 5.0]])[1:].requires_grad_()
    gaussians = Gaussians(tensor([0, 0, 2]), tensor([1, 0, 0, 0]), tensor([1, 1, 1]), tensor(0.5), colors)
    rgb = layers(gaussians, SMALL).colors
    assert rgb[0, 0] == 0
    rgb.sum().backward()
    torch.testing.assert_close(colors.grad[0, 0], tensor(0.0, 1.0, 1.0) * 0.28209479177387814)
