"""The rules of the reference: what is left out, clamp, threshold, stop."""

import math

import pytest
import torch
from factories import FIELDS, pinhole, random_camera, random_gaussians, replace, with_camera
from reference_checks import BLUE, EXACT, GREEN, RED, SMALL, fields, one, stack, tensor

from kgs import Gaussians
from kgs.reference import layers, render


@pytest.mark.parametrize("z", [-5.0, -1e-30, 0.0, 0.01])
def test_nothing_up_to_the_near_plane_is_drawn(z):
    leaves = {name: value.clone().requires_grad_() for name, value in fields(one([0, 0, z], [0.1] * 3)).items()}
    background = tensor(0.2, 0.4, 0.6).requires_grad_()
    image = render(Gaussians(**leaves), SMALL, background)
    assert torch.equal(image, background.detach()[None, :, None, None].expand_as(image))
    image.sum().backward()
    assert all(torch.equal(leaf.grad, torch.zeros_like(leaf)) for leaf in leaves.values())


def test_just_behind_the_near_plane_is_drawn():
    z = math.nextafter(0.01, 1.0)
    means = tensor([0.0, 0.0, z]).requires_grad_()
    image = render(replace(one([0, 0, z], [0.1] * 3), means=means), SMALL)
    assert float(image[0, 0].detach().min()) > 0.7
    image.sum().backward()
    assert means.grad.isfinite().all()


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_gaussian_that_is_not_finite_is_left_out(name, value):
    gaussians, camera = random_gaussians(10, 12, sh_degree=1), random_camera(8, 9, 12)
    leaves = {key: leaf.clone() for key, leaf in fields(gaussians).items()}
    leaves[name][4].view(-1)[0] = value
    leaves = {key: leaf.requires_grad_() for key, leaf in leaves.items()}
    extrinsics = camera.extrinsics[0].clone().requires_grad_()
    image = render(Gaussians(**leaves), with_camera(camera, extrinsics=extrinsics))
    keep = torch.arange(10) != 4
    others = Gaussians(*(getattr(gaussians, key)[keep] for key in FIELDS))
    assert torch.equal(image, render(others, camera))
    image.sum().backward()
    assert extrinsics.grad.isfinite().all()
    assert all(leaf.grad.isfinite().all() and (leaf.grad[4] == 0).all() for leaf in leaves.values())


def test_no_gaussians_leave_the_background():
    gaussians = Gaussians(*(value[:0] for value in fields(random_gaussians(1, 0, sh_degree=3)).values()))
    assert torch.equal(render(gaussians, SMALL), torch.zeros(1, 3, 4, 5).double())


@pytest.mark.parametrize(("opacity", "slope"), [(0.98, 1.0), (0.99, 1.0), (0.995, 0.0), (1.3, 0.0)])
def test_alpha_is_clamped_at_099_with_the_clamps_gradient(opacity, slope):
    opacities = tensor(opacity).requires_grad_()
    gaussian = replace(one([0, 0, 2], [0.1] * 3), opacities=opacities)
    pixel = render(gaussian, pinhole(3, 3, 50), **EXACT)[0, 0, 1, 1]  # G = 1 in the centre
    assert float(pixel.detach()) == pytest.approx(min(opacity, 0.99), abs=1e-15)
    pixel.backward()
    assert opacities.grad.item() == slope


def test_alpha_at_the_threshold_is_drawn():
    assert float(render(one([0, 0, 2], [0.1] * 3, 0.25), pinhole(3, 3, 50), None, 0.25)[0, 0, 1, 1]) == 0.25


def test_the_layer_that_crosses_the_stop_counts_and_no_later_one():
    background = tensor(1.0, 1.0, 1.0)
    opaque = stack([0.99, 0.99, 0.99], [RED, GREEN, BLUE], scale=1e9)
    image = render(opaque, SMALL, background, transmittance_stop=1e-3)
    torch.testing.assert_close(image[0, :, 0, 0], tensor(0.99, 0.0099, 0.0), rtol=0, atol=1e-12)
    drawn = layers(opaque, SMALL, transmittance_stop=1e-3)
    assert (drawn.transmittance == 0).all()
    assert (drawn.weights[2] == 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_two_opaque_layers_do_not_let_the_background_shine_through(dtype):
    opaque = stack([0.99, 0.99], [RED, GREEN], scale=1e9)
    opaque = Gaussians(**{name: value.to(dtype) for name, value in fields(opaque).items()})
    image = render(opaque, pinhole(4, 5, 10, dtype=dtype), torch.ones(3, dtype=dtype))
    assert image.dtype == torch.float64
    assert float((image[0, :, 0, 0] - tensor(0.99, 0.0099, 0.0)).abs().max()) < 2e-4
