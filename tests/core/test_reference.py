"""The dense reference against 50 digits, by hand where a limit or a sum is known."""

import itertools
import math

import pytest
import torch
from factories import FIELDS, pinhole, random_camera, random_gaussians, replace, whole_matrices, with_camera
from kornia.geometry.camera import PinholeCamera
from oracles import mpmath_pixels
from reference_checks import BLUE, EXACT, GREEN, RED, SMALL, fields, one, stack, tensor

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


# -- rules -----------------------------------------------------------------------------------------------------------


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


# -- gradients -------------------------------------------------------------------------------------------------------


def test_equal_depths_keep_the_order_of_the_gaussians():
    gaussians = stack([0.6, 0.6, 0.6], [RED, GREEN, BLUE])
    gaussians = replace(gaussians, means=gaussians.means.clone().index_fill_(1, torch.tensor([2]), 2.0))
    image = render(gaussians, SMALL)
    torch.testing.assert_close(image[0, :, 0, 0], tensor(0.6, 0.24, 0.096), rtol=0, atol=1e-9)


def test_zero_quaternion_is_the_identity_with_zero_gradient():
    quats = torch.zeros(1, 4, dtype=torch.float64, requires_grad=True)
    gaussians = replace(one([0.1, 0, 2], [0.1, 0.2, 0.3]), quats=quats)
    image = render(gaussians, SMALL)
    assert torch.equal(image, render(replace(gaussians, quats=tensor([1, 0, 0, 0])), SMALL))
    image.sum().backward()
    assert torch.equal(quats.grad, torch.zeros_like(quats))


def scene(seed: int, sh_degree: int | None = 3) -> tuple[Gaussians, PinholeCamera]:
    """Four Gaussians inside the tangent limits of a 6x6 camera with skew; no colour or alpha at a clamp."""
    gaussians = random_gaussians(4, seed, sh_degree=sh_degree, image_size=6, opacities=(0.2, 0.9))
    camera = random_camera(6, 6, seed)
    camera.intrinsics[0, 0, 1] = 0.4
    gaussians = replace(gaussians, means=gaussians.means * tensor(0.6, 0.6, 1), scales=gaussians.scales / 2)
    return gaussians, camera


@pytest.mark.parametrize("sh_degree", [None, pytest.param(3, marks=pytest.mark.slow)])
def test_gradients_of_all_inputs(sh_degree):
    gaussians, camera = scene(0, sh_degree)
    colors = gaussians.colors if sh_degree is None else gaussians.colors / 4

    def image(means, quats, scales, opacities, colors, extrinsics, intrinsics, background):
        seen = with_camera(camera, extrinsics=extrinsics, intrinsics=whole_matrices(intrinsics)[0])
        return render(Gaussians(means, quats, scales, opacities, colors), seen, background, **EXACT)

    inputs = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors]
    inputs += [camera.extrinsics[0], camera.intrinsics[:, :2, :3], tensor(0.1, 0.5, 0.9)]
    inputs = [value.detach().clone().requires_grad_() for value in inputs]
    assert torch.autograd.gradcheck(image, inputs, eps=1e-6, atol=1e-7)
    for value, gradient in zip(inputs, torch.autograd.grad(image(*inputs).square().sum(), inputs), strict=True):
        assert float(gradient.abs().max()) > 1e-4, value.shape


@pytest.mark.parametrize("fraction", [0.5, 0.99, 1.01, 3.0])
def test_gradient_follows_the_tangent_clamp(fraction):
    camera = pinhole(6, 6, 8, centre=(1.5, 3.0))
    limit = (6 - 0.5 - 1.5 + 0.15 * 6) / 8
    gaussians, _ = scene(1, None)
    means = tensor([2 * fraction * limit, 0.3, 2.0], [-0.3, -3 * fraction, 3.0])
    scales, quats = tensor([0.6, 0.9, 0.4], [1.0, 0.7, 0.5]), gaussians.quats[:2]

    def image(means, scales, extrinsics, intrinsics):
        two = Gaussians(means, quats, scales, gaussians.opacities[:2], gaussians.colors[:2])
        seen = with_camera(camera, extrinsics=extrinsics, intrinsics=whole_matrices(intrinsics)[0])
        return render(two, seen, **EXACT)

    inputs = [means, scales, camera.extrinsics[0], camera.intrinsics[:, :2, :3]]
    inputs = [value.detach().clone().requires_grad_() for value in inputs]
    assert torch.autograd.gradcheck(image, inputs, eps=1e-6, atol=1e-7)


def test_opacities_of_one_camera_may_be_a_row():
    gaussians, camera = random_gaussians(10, 13), random_camera(8, 9, 13)
    assert torch.equal(
        render(gaussians, camera), render(replace(gaussians, opacities=gaussians.opacities[None]), camera)
    )
