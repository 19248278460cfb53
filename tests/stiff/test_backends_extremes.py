"""The projection of each backend where numbers are not finite, overflow or vanish."""

import math

import numpy as np
import pytest
import torch
from factories import FIELDS, replace, select
from projection_checks import assert_alike, list_and_gradients, wide_scene

from kgs import GaussianRenderer, Gaussians, composite, project
from kgs.harmonics import SH_C0


@pytest.mark.parametrize("poison", [torch.nan, torch.inf, -torch.inf])
def test_what_is_not_finite_is_counted_once_and_left_out(kernel_backend, poison):
    gaussians, cameras = wide_scene(3, cameras=2)
    fields = {name: getattr(gaussians, name).clone() for name in FIELDS}
    fields["opacities"] = fields["opacities"].repeat(2, 1)
    for i, value in enumerate(fields.values()):
        value[(1, 10 + i) if value.shape[0] == 2 else 10 + i].view(-1)[-1] = poison
    fields["colors"][20, 1], fields["colors"][20, 2] = torch.inf, -torch.inf
    fields["colors"][21] = 3e37  # finite, the sum is not
    poisoned = Gaussians(**fields)
    (got, grads), (listed, _) = (
        list_and_gradients(poisoned, cameras, backend) for backend in (kernel_backend, "torch")
    )
    assert got.num_nonfinite.item() == listed.num_nonfinite.item() == 6
    assert torch.equal(got.gaussian_ids, listed.gaussian_ids)
    kept = torch.tensor([i for i in range(400) if i not in (10, 11, 12, 13, 14, 20, 21)])
    expected = list_and_gradients(select(poisoned, kept), cameras, "torch")[1]
    for name, grad in grads.items():
        rows, same = (x.T if name == "opacities" else x for x in (grad, expected[name]))
        assert (rows[torch.tensor([10, 11, 12, 13, 14, 20])] == 0).all()
        torch.testing.assert_close(rows[kept], same, rtol=1e-4, atol=1e-5 * float(same.abs().max()))


@pytest.mark.parametrize("power", [-44.0, 20.0, 44.0, 60.0, 88.0])
@pytest.mark.parametrize("axes", [1, 3])
def test_footprints_that_overflow_are_left_out_with_gradient_zero(kernel_backend, power, axes):
    gaussians, cameras = wide_scene()
    scales = gaussians.scales.clone()
    scales[:50, :axes] = np.exp(power)
    gaussians = replace(gaussians, scales=scales)
    (got, grads), (listed, _) = (
        list_and_gradients(gaussians, cameras, backend) for backend in (kernel_backend, "torch")
    )
    assert torch.equal(got.gaussian_ids, listed.gaussian_ids)
    left_out = torch.ones(400, dtype=torch.bool)
    left_out[got.gaussian_ids] = False
    for name in FIELDS:
        assert (grads[name][left_out] == 0).all()
        assert grads[name].isfinite().all()


@pytest.mark.parametrize("norm", [0.0, 1e-40, 1e-30, 1e30])
def test_quaternions_of_any_norm(kernel_backend, norm):
    gaussians, cameras = wide_scene(n=30)
    gaussians = replace(gaussians, quats=torch.nn.functional.normalize(gaussians.quats) * norm)
    (got, grads), (listed, _) = (
        list_and_gradients(gaussians, cameras, backend) for backend in (kernel_backend, "torch")
    )
    bound = 1e-4 * float(listed.factors.detach().abs().max())
    assert torch.allclose(got.factors, listed.factors, rtol=1e-5, atol=bound)
    if norm == 0.0:
        assert not grads["quats"].any()


def test_needles_seen_from_far_and_near(kernel_backend):
    gaussians, cameras = wide_scene(n=200)
    scales = gaussians.scales.clone()
    scales[:, 0] *= 1e3
    scales[:, 1] *= 1e-3
    assert_alike(replace(gaussians, scales=scales), cameras, kernel_backend)


def test_a_color_of_exactly_zero_passes_the_gradient_and_one_below_does_not(kernel_backend):
    gaussians, cameras = wide_scene(0, n=40)
    near = np.float32(-0.5 / SH_C0)
    zeros = [
        x
        for x in (near, np.nextafter(near, np.float32(0)), np.nextafter(near, near - np.float32(1)))
        if np.float32(SH_C0) * x == -0.5
    ]
    assert zeros
    colors = torch.tensor(zeros).repeat(40)[:40, None, None].repeat(1, 1, 3)
    colors[:, :, 1], colors[:, :, 2] = -3.0, 3.0
    got, grads = list_and_gradients(replace(gaussians, colors=colors), cameras, kernel_backend)
    _, same = list_and_gradients(replace(gaussians, colors=colors), cameras, "torch")
    assert got.colors[:, 1].eq(0).all()
    assert torch.allclose(grads["colors"], same["colors"], rtol=1e-6)
    assert grads["colors"][got.gaussian_ids, 0, 0].ne(0).all()


@pytest.mark.parametrize("degree", [None, 0, 3])
def test_nothing_to_see(kernel_backend, degree):
    gaussians, cameras = wide_scene(degree, cameras=2)
    for none in (gaussians[:0], replace(gaussians, means=-gaussians.means.abs() - 100)):
        got, grads = assert_alike(none, cameras, kernel_backend)
        assert len(got) == 0
        assert all(x is not None and not x.any() for x in grads.values())


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", [0.0, 1e-45, 1e-30, 1e10, 1.8e19, 1e20, 1e30])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_extreme_values_spoil_no_other_gaussian(field, value, degree):
    """Some Gaussians are far, huge or tiny in one field: images and gradients of all others are those of torch."""
    gaussians, cameras = wide_scene(degree, cameras=2)
    values = getattr(gaussians, field).clone()
    some = slice(5, 15)
    values[some] = values[some] * value if field in ("means", "scales") else value
    changed = replace(gaussians, **{field: values})
    (image, grads), (expected, same) = (image_and_gradients(changed, cameras, name) for name in ("numba", "torch"))
    rounding = 1e-5 + 1e-6 * max(0.0, math.log2(value or 1.0)) * (field == "opacities")  # of the exponent
    torch.testing.assert_close(image, expected, rtol=1e-4, atol=rounding * float(expected.abs().max()))
    for name in FIELDS:
        got, wanted = (torch.cat([x[name][:5], x[name][15:]]) for x in (grads, same))
        assert got.isfinite().all()
        torch.testing.assert_close(got, wanted, rtol=1e-3, atol=1e-5 * float(wanted.abs().max()))


def image_and_gradients(gaussians, cameras, backend):
    inputs = {name: getattr(gaussians, name).detach().clone().requires_grad_() for name in FIELDS}
    image = GaussianRenderer(backend=backend)(Gaussians(**inputs), cameras).image
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    (image * weights).sum().backward()
    return image.detach(), {name: value.grad for name, value in inputs.items()}


def test_tensors_with_the_negative_bit(kernel_backend):
    """What `conj().imag` gives: a view whose numbers stand in memory with the other sign."""
    gaussians, cameras = wide_scene(1, n=60)
    lazy = {name: torch.complex(torch.zeros_like(x), -x).conj().imag for name, x in vars(gaussians).items()}
    assert all(x.is_neg() for x in lazy.values())
    for first, second in zip(
        projected_and_composited(Gaussians(**lazy), cameras, kernel_backend),
        projected_and_composited(gaussians, cameras, kernel_backend),
        strict=True,
    ):
        assert torch.equal(first, second)


def projected_and_composited(gaussians, cameras, backend):
    projected = project(gaussians, cameras, backend=backend)
    return projected.means2d, projected.colors, composite(projected, projected.colors, backend=backend).features
