"""Footprints against exact rational arithmetic and 40-digit arithmetic; rotations against SciPy's."""

import itertools
import math
from fractions import Fraction

import mpmath
import pytest
import torch
from mpmath import mpf
from scipy.spatial.transform import Rotation

from kgs.geometry.covariance import conics, footprint_factors, rotation_matrices, variances, whitening

EPS2D = 0.3


def normal(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def dense(factors, eps2d=EPS2D):
    return factors @ factors.mT + eps2d * torch.eye(2, dtype=factors.dtype)


# -- rotations -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 7e-7), (torch.float64, 1e-14)])
def test_convention_rotations_are_scipys_and_orthonormal(dtype, tolerance):
    quats = normal(100, 4)
    expected = torch.from_numpy(Rotation.from_quat(quats.roll(-1, 1).numpy()).as_matrix())
    got = rotation_matrices((quats * normal(100, 1, seed=1).exp()).to(dtype)).double()
    torch.testing.assert_close(got, expected, rtol=0, atol=tolerance)
    torch.testing.assert_close(got.mT @ got, torch.eye(3).to(got).expand(100, 3, 3), rtol=0, atol=2 * tolerance)
    torch.testing.assert_close(torch.linalg.det(got), torch.ones(100).to(got), rtol=0, atol=2 * tolerance)


@pytest.mark.parametrize("norm", [1e-30, 1e-12, 3.0, 1e12, 1e30])
def test_the_norm_does_not_matter(norm):
    quats = normal(50, 4, dtype=torch.float32)
    torch.testing.assert_close(rotation_matrices(quats * norm), rotation_matrices(quats), rtol=0, atol=6e-7)
    exactly = 2.0 ** round(math.log2(norm))  # scales without rounding
    assert torch.equal(rotation_matrices(quats * exactly), rotation_matrices(quats))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_zero_is_the_identity_with_zero_gradient(dtype):
    quats = torch.zeros(2, 4, dtype=dtype, requires_grad=True)
    turn = rotation_matrices(quats)
    assert torch.equal(turn, torch.eye(3, dtype=dtype).expand(2, 3, 3))
    (turn * normal(2, 3, 3, dtype=dtype)).sum().backward()
    assert torch.equal(quats.grad, torch.zeros_like(quats))


@pytest.mark.parametrize("norm", [1e-30, 1e-6, 1.0, 1e6, 1e30])
def test_gradient_is_finite_and_tangential_and_shrinks_with_the_norm(norm):
    unit = torch.nn.functional.normalize(normal(50, 4), dim=1)
    weights = normal(50, 3, 3, seed=1)

    def gradient(quats):
        quats = quats.requires_grad_()
        (rotation_matrices(quats) * weights.to(quats)).sum().backward()
        return quats.grad.double()

    got = gradient((unit * norm).float()) * norm
    torch.testing.assert_close(got, gradient(unit.clone()), rtol=0, atol=2e-5)
    assert ((got * unit).sum(1).abs() <= 1e-6 * got.norm(dim=1)).all()


def test_gradcheck_of_rotation_and_factors():
    rows, quats, scales = normal(4, 2, 3), normal(4, 4, seed=1), normal(4, 3, seed=2).exp()
    inputs = [value.requires_grad_() for value in (rows, quats, scales)]
    assert torch.autograd.gradcheck(footprint_factors, inputs)
    assert torch.autograd.gradcheck(lambda *x: torch.stack(variances(footprint_factors(*x), EPS2D)), inputs)
    assert torch.autograd.gradcheck(lambda *x: conics(*variances(footprint_factors(*x), EPS2D)), inputs)
    assert torch.autograd.gradcheck(lambda *x: torch.stack(whitening(*variances(footprint_factors(*x), EPS2D))), inputs)


@pytest.mark.parametrize("norm", [1e-30, 1e-3, 1.0, 1e30])
def test_factors_have_the_gradients_of_kornias_rotation(norm):
    inputs = [normal(9, 2, 3), normal(9, 4, seed=1) * norm, normal(9, 3, seed=2).exp()]
    inputs = [value.requires_grad_() for value in inputs]
    inputs[1].data[0] = 0.0  # the identity, with no gradient
    rows, quats, scales = inputs
    weights = normal(9, 2, 3, seed=3)
    expected = torch.autograd.grad((rows @ rotation_matrices(quats) * scales[:, None] * weights).sum(), inputs)
    got = torch.autograd.grad((footprint_factors(*inputs) * weights).sum(), inputs)
    for one, other in zip(got, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-13 * float(other.abs().max()))
    assert not got[1][0].any()


def test_factors_have_no_second_derivative():
    rows, quats, scales = normal(2, 2, 3), normal(2, 4, seed=1).requires_grad_(), normal(2, 3, seed=2).exp()
    with pytest.raises(RuntimeError, match="second derivative"):
        torch.autograd.grad(footprint_factors(rows, quats, scales).sum(), quats, create_graph=True)


# -- ordinary footprints -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("eps2d", [0.0, 0.3, 2.0])
def test_conic_is_the_inverse_and_whitening_its_root(eps2d):
    factors = 3 * normal(200, 2, 3)
    entries = variances(factors, eps2d)
    sigma = dense(factors, eps2d)
    for got, expected in zip(
        entries, (sigma[:, 0, 0], sigma[:, 0, 1], sigma[:, 1, 1], torch.linalg.det(sigma)), strict=True
    ):
        torch.testing.assert_close(got, expected, rtol=1e-11, atol=1e-12)
    inverse = torch.linalg.inv(sigma)
    a, b, c = conics(*variances(factors, eps2d)).unbind(1)
    torch.testing.assert_close(torch.stack([a, b, b, c], 1).reshape(-1, 2, 2), inverse, rtol=1e-9, atol=1e-12)
    assert (entries[0] > entries[2]).any(), "both pivots must occur"
    assert (entries[0] < entries[2]).any()
    root = torch.stack(whitening(*entries), 1).reshape(-1, 2, 2)
    offsets = 5 * normal(200, 2, seed=1)
    whitened = (root @ offsets[:, :, None]).square().sum((1, 2))
    expected = (offsets[:, None] @ inverse @ offsets[:, :, None])[:, 0, 0]
    torch.testing.assert_close(whitened, expected, rtol=1e-9, atol=0)


def test_equal_variances_are_whitened_too():
    root = torch.stack(whitening(*(torch.tensor([v], dtype=torch.float64) for v in (4.0, 0.0, 4.0, 16.0)))).reshape(
        2, 2
    )
    torch.testing.assert_close(root.mT @ root, torch.eye(2, dtype=torch.float64) / 4)


# -- needles and pancakes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [1.0, 1e2, 1e4, 1e6])
def test_float32_entries_of_a_given_factor_are_right_to_the_last_digits(ratio):
    long, short = normal(200, 2, 1), normal(200, 2, 1, seed=1)
    factors = (long @ normal(200, 1, 3, seed=2) * ratio + short @ normal(200, 1, 3, seed=3)).float()
    got = torch.stack(variances(factors, EPS2D), 1)
    eps = Fraction(EPS2D)
    for factor, (xx, xy, yy, det) in zip(factors.tolist(), got.tolist(), strict=True):
        mx, my = ([Fraction(value) for value in row] for row in factor)
        exact_xx, exact_yy = sum(v * v for v in mx) + eps, sum(v * v for v in my) + eps
        exact_xy = sum(v * w for v, w in zip(mx, my, strict=True))
        exact_det = exact_xx * exact_yy - exact_xy**2
        assert det > 0
        cross, rounding = exact_det - eps * (exact_xx + exact_yy - eps), Fraction(2e-7) ** 2 * exact_xx * exact_yy
        error = abs(Fraction(det) - exact_det)
        assert error < 1e-6 * exact_det + 2 * math.sqrt(cross * rounding) + rounding
        assert abs(Fraction(xx) / exact_xx - 1) < 1e-6
        assert abs(Fraction(yy) / exact_yy - 1) < 1e-6
        assert abs(Fraction(xy) - exact_xy) ** 2 < Fraction(1e-12) * exact_xx * exact_yy


def exact_footprint(row_pair, quat, scale):
    """Covariance with 40 digits from float32 inputs."""
    w, x, y, z = (mpf(value) for value in quat)
    turn = mpmath.matrix(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    ) / (w * w + x * x + y * y + z * z)
    factor = mpmath.matrix(row_pair) * turn * mpmath.diag([mpf(value) for value in scale])
    return factor * factor.T + mpf(EPS2D) * mpmath.eye(2)


@pytest.mark.parametrize(
    ("shape", "ratio", "bound"),  # bounds: 5 x the errors of this form measured in docs, small axis 0.02 px
    [
        ("needle", 1e2, 2e-6),
        ("needle", 1e3, 2e-5),
        ("needle", 1e4, 1.5e-4),
        ("needle", 1e5, 1.5e-3),
        ("needle", 1e6, 8e-3),
        ("pancake", 1e6, 4e-4),
    ],
)
def test_float32_chain_on_needles_and_pancakes(shape, ratio, bound):
    n, small = 60, 0.02
    rows = torch.linalg.qr(normal(n, 3, 3))[0][:, :2].float()
    quats = normal(n, 4, seed=1, dtype=torch.float32)
    long = small * ratio
    scales = torch.tensor([[long, small, small] if shape == "needle" else [long, long, small]]).expand(n, 3)
    xx, xy, yy, det = variances(footprint_factors(rows, quats, scales), EPS2D)
    root = torch.stack(whitening(xx, xy, yy, det), 1).double().reshape(n, 2, 2)
    assert (det > 0).all()
    generator = torch.Generator().manual_seed(3)
    with mpmath.workdps(40):
        for i in range(n):
            sigma = exact_footprint(rows[i].tolist(), quats[i].tolist(), scales[i].tolist())
            exact_det = sigma[0, 0] * sigma[1, 1] - sigma[0, 1] ** 2
            assert abs(mpf(det[i].item()) / exact_det - 1) < (1e-4 if shape == "needle" else 1e-2)
            cholesky = mpmath.cholesky(sigma)
            for white in (2 * torch.rand(4, 2, generator=generator, dtype=torch.float64) - 1) * 2.1:
                offset = cholesky * mpmath.matrix(white.tolist())
                shrink = min(mpf(1), 2000 / mpmath.norm(offset))
                offset *= shrink
                exact = mpmath.exp(-(shrink**2) * float(white @ white) / 2)
                d = torch.tensor([float(offset[0]), float(offset[1])], dtype=torch.float64)
                got = torch.exp(-(root[i] @ d).square().sum() / 2).item()
                assert abs(got - exact) < bound


@pytest.mark.parametrize("tilt", [0.0, 1e-5, 1e-3, 1e-2])
@pytest.mark.parametrize("along", [0, 1])
def test_needles_nearly_along_an_axis(along, tilt):
    """2000 px long, 0.02 px thin: the exponent must not be the difference of two large numbers."""
    directions = torch.tensor(
        [[math.cos(tilt), math.sin(tilt)], [-math.sin(tilt), math.cos(tilt)]], dtype=torch.float64
    )
    factors = torch.zeros(1, 2, 3)
    factors[0, :, :2] = (directions.T * torch.tensor([2000.0, 0.02])).float()
    factors = factors.flip(1) if along else factors
    root = torch.stack(whitening(*variances(factors, EPS2D)), 1).double().reshape(2, 2)
    exact = torch.linalg.inv(dense(factors.double()))[0]
    for reach, side in itertools.product((-1500.0, 3.0, 800.0), (-0.5, 0.0, 0.7)):
        d = (reach * directions[0] + side * directions[1]).float().double()
        d = d.flip(0) if along else d
        got, expected = torch.exp(-(root @ d).square().sum() / 2), torch.exp(-(d @ exact @ d) / 2)
        assert abs(got - expected) < 1.5e-3


def test_flat_footprints_without_dilation_have_determinant_zero():
    scales = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    rows = torch.eye(3, dtype=torch.float64)[:2].expand(2, 2, 3)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(2, 4)
    assert torch.equal(variances(footprint_factors(rows, quats, scales), 0.0)[3], torch.zeros(2, dtype=torch.float64))
