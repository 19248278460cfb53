"""Harmonics against mpmath's complex ones, in the order and with the signs of 3DGS PLY files."""

import math

import mpmath
import pytest
import torch
from oracles import real_harmonic

from kgs.geometry.harmonics import SH_C0, evaluate_harmonics, harmonics_basis

AXES = torch.tensor(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=torch.float64
)  # the poles of the polar angle included


def directions(n=30, seed=0, dtype=torch.float64):
    random = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.cat([AXES, torch.nn.functional.normalize(random, dim=1)]).to(dtype)


def coefficients(m, bands, seed=1, dtype=torch.float64):
    return 0.3 * torch.randn(m, bands, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 1e-6)])
def test_convention_basis_is_mpmaths(dtype, tolerance):
    vectors = directions(dtype=dtype)
    expected = []
    for x, y, z in vectors.double().tolist():
        polar, azimuth = mpmath.acos(z / mpmath.sqrt(x * x + y * y + z * z)), mpmath.atan2(y, x)
        expected.append([float(real_harmonic(k, polar, azimuth)) for k in range(16)])
    got = harmonics_basis(vectors, 3).double()
    torch.testing.assert_close(got, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=tolerance)


def test_convention_signs_are_those_of_ply_files():
    """The first band is -y, z, -x; written out by hand for the axes, with no formula at all."""
    c1 = math.sqrt(3 / (4 * math.pi))
    basis = harmonics_basis(AXES[[0, 2, 4]], 1)
    expected = torch.tensor([[0, 0, -c1], [-c1, 0, 0], [0, c1, 0]], dtype=torch.float64)
    torch.testing.assert_close(basis[:, 1:], expected, rtol=1e-14, atol=1e-16)
    assert math.isclose(SH_C0, 1 / math.sqrt(4 * math.pi), rel_tol=1e-15)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colour_is_the_sum_of_the_first_bands_plus_one_half_and_never_negative(degree):
    vectors, size = directions(), (degree + 1) ** 2
    colors = 3 * coefficients(len(vectors), size)
    basis = harmonics_basis(vectors, degree)
    assert torch.equal(basis, harmonics_basis(vectors, 3)[:, :size])
    got = evaluate_harmonics(colors, vectors)
    torch.testing.assert_close(got, (torch.einsum("mk,mkc->mc", basis, colors) + 0.5).clamp_min(0))
    assert (got == 0).any()
    assert (got > 1).any(), "not clamped from above"


def test_degree_0_ignores_the_direction():
    colors = coefficients(3, 1)
    got = evaluate_harmonics(colors, torch.full((3, 3), torch.nan, dtype=torch.float64))
    torch.testing.assert_close(got, 0.5 + colors[:, 0] / math.sqrt(4 * math.pi))


def test_at_exactly_zero_the_gradient_passes_and_below_it_does_not():
    at_zero = torch.tensor([[[-0.5 / SH_C0] * 3]], dtype=torch.float64, requires_grad=True)
    color = evaluate_harmonics(at_zero, AXES[:1])
    assert torch.equal(color, torch.zeros(1, 3, dtype=torch.float64)), "the test needs the exact kink"
    color.sum().backward()
    assert torch.equal(at_zero.grad, torch.full_like(at_zero, SH_C0))
    below = (at_zero.detach() - 1e-6).requires_grad_()
    evaluate_harmonics(below, AXES[:1]).sum().backward()
    assert torch.equal(below.grad, torch.zeros_like(below))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradcheck(degree):
    vectors = directions(3).requires_grad_()
    colors = (0.3 * coefficients(len(vectors), (degree + 1) ** 2)).requires_grad_()
    assert (evaluate_harmonics(colors, vectors) > 0.01).all()
    assert torch.autograd.gradcheck(evaluate_harmonics, (colors, vectors) if degree else (colors, vectors.detach()))
