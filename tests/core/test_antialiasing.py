"""Anti-aliasing and the far plane: closed forms, the reference, gradients. See also the tests against gsplat."""

import dataclasses
import math

import pytest
import torch
from factories import footprints, pinhole, random_camera, random_gaussians, staged
from oracles import theta_mass
from reference_checks import one

import kgs.reference
from kgs import GaussianRenderer, RasterOptions, project
from kgs.geometry.covariance import compensations

EXACT = {"alpha_threshold": 0.0, "transmittance_stop": 0.0}
pytestmark = pytest.mark.usefixtures("each_backend")


@pytest.mark.parametrize("sigma", [0.01, 0.1, 0.3, 1.0, 2.0])
def test_a_footprint_keeps_its_sum(sigma, exactly):
    """Over all pixels 2 pi o times the root of the determinant before it is widened."""
    dtype, bound = exactly
    factors = torch.tensor([[[sigma, 0.0, 0.0], [0.0, 2 * sigma, 0.0]]], dtype=dtype)
    size, eps2d = (61, 61), 0.3
    given = footprints(torch.tensor([[30.3, 29.8]], dtype=dtype), factors, torch.tensor([0.5]).to(dtype), size, eps2d)
    opacities = given.opacities * compensations(factors, eps2d)
    image = kgs.composite(
        dataclasses.replace(given, opacities=opacities), torch.ones(1, 1, dtype=dtype), **staged(**EXACT)
    )
    widths = [sigma**2 + eps2d, 4 * sigma**2 + eps2d]
    sums = [theta_mass(width, centre) for width, centre in zip(widths, (30.3, 29.8), strict=True)]
    expected = 0.5 * 2 * sigma**2 / math.sqrt(widths[0] * widths[1]) * sums[0] * sums[1]
    assert float(image.features.sum()) == pytest.approx(expected, rel=max(1e3 * bound, 1e-9))
    if min(widths) > 0.5:  # where the pixels are fine enough for the sum to be the integral
        assert expected == pytest.approx(0.5 * 2 * math.pi * 2 * sigma**2, rel=1e-4)


@pytest.mark.usefixtures("torch_alone")
@pytest.mark.parametrize("sigma", [1e-3, 0.05, 0.5, 5.0])
def test_the_factor_has_the_gradient_of_finite_differences(sigma):
    factors = sigma * torch.randn(5, 2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: compensations(x, 0.3), factors.requires_grad_(), eps=1e-6 * sigma)


@pytest.mark.usefixtures("torch_alone")
def test_flat_footprints_have_the_factor_zero_and_no_infinite_gradient():
    factors = torch.zeros(3, 2, 3)
    factors[1, 0, 0] = 2.0
    factors[2] = torch.tensor([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]])
    factors.requires_grad_()
    factor = compensations(factors, 0.3)
    assert not factor.any()
    factor.sum().backward()
    assert factors.grad.isfinite().all()


def test_without_a_low_pass_filter_there_is_nothing_to_correct():
    gaussians, camera = random_gaussians(30, 0, torch.float32, 0, 32), random_camera(24, 32, 0, torch.float32)
    plain, antialiased = (GaussianRenderer(eps2d=0.0, antialiased=x)(gaussians, camera).image for x in (False, True))
    assert torch.equal(plain, antialiased)


def test_a_gaussian_at_the_far_plane_is_left_out():
    gaussian, camera = one([0, 0, 2], [0.1] * 3), pinhole(15, 17, 50)
    for far_plane, seen in ((1.0, 0), (2.0, 0), (2.01, 1)):
        assert len(project(gaussian, camera, options=RasterOptions(far_plane=far_plane))) == seen
