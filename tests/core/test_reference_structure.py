"""Gradients of the reference against finite differences, its order of equal depths, and what it takes."""

import pytest
import torch
from factories import pinhole, random_camera, random_gaussians, replace, whole_matrices, with_camera
from kornia.geometry.camera import PinholeCamera
from reference_checks import BLUE, EXACT, GREEN, RED, SMALL, one, stack, tensor

from kgs import Gaussians
from kgs.reference import render


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
