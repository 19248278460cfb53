"""The projection of kernels against that of torch: the same list, values and gradients within float32."""

import math

import numpy as np
import pytest
import torch
from factories import (
    FIELDS,
    LENS_PARAMS,
    leaves,
    pinhole,
    posed,
    random_gaussians,
    replace,
    with_camera,
)
from kornia.sensors.camera import CameraModelType
from projection_checks import DIFFERENTIABLE, list_and_gradients, wide_scene
from refusals import refused
from targets import COMPILED, SELDOM_INTERPRETED, TORCH

import kgs
from kgs import ArgumentError, GaussianRenderer, Gaussians, RasterOptions, composite, project
from kgs.geometry.harmonics import SH_C0


def test_the_limits_of_the_tangents_belong_to_what_has_a_gradient(kernels):
    # x / z, y / z at, within and beyond the limits (8.5 + 2.4) / 8 and (4.5 + 1.2) / 8, both exact in binary
    camera = pinhole(8, 16, 8.0, (8.0, 4.0), dtype=torch.float32)
    limits = kgs.geometry.lenses.tangent_limits(
        torch.tensor([8.0, 8.0]), torch.tensor([8.0, 4.0]), kgs.geometry.lenses.whole_frame((8, 16))
    )
    x = torch.stack([limits[0, 0], limits[0, 1], limits[0, 1] * 1.5, limits[0, 0] * 0.5])
    y = torch.stack([limits[1, 1], limits[1, 0] * 2, limits[1, 0], limits[1, 1] * 0.5])
    base = random_gaussians(4, 0, torch.float32, 1)
    gaussians = replace(base, means=torch.stack([x, y, torch.ones(4)], 1), scales=torch.full((4, 3), 0.5))
    got, grads, _ = list_and_gradients(gaussians, camera, kernels, alpha_threshold=0.0)
    expected = list_and_gradients(gaussians, camera, alpha_threshold=0.0)[1]
    assert got.gaussian_ids.tolist() == [0, 1, 2, 3]
    assert torch.allclose(grads["means"], expected["means"], rtol=1e-5, atol=1e-5)


def test_gaussians_of_which_one_value_or_none_has_a_gradient_and_what_is_not_a_number(kernels):
    gaussians, cameras = wide_scene(3, 40, cameras=2)
    found = []
    for target, dtype in ((kernels, torch.float32), (TORCH, torch.float64)):
        moved, inputs = leaves(target.move(gaussians, dtype))
        got = project(moved, target.move(cameras, dtype), backend=target.backend)
        values = [getattr(got, name) for name in DIFFERENTIABLE]
        weights = [torch.zeros_like(value) for value in values]
        for i, weight in enumerate(weights):  # every sixth row has none
            weight[i::6] = torch.arange(1.0, 1.0 + weight[i::6].numel()).to(weight).view_as(weight[i::6])
        found.append([x.cpu() for x in torch.autograd.grad(values, inputs, weights, retain_graph=True)])
        weights[3][0] = torch.nan
        broken = torch.autograd.grad(values, inputs, weights)[3].cpu()
        assert broken.isnan().nonzero().tolist() == [[int(got.gaussian_ids[0])]]
    for x, y in zip(*found, strict=True):
        assert (x - y).abs().max() <= 3e-6 * y.abs().max()
        assert not bool(y.all())


def test_a_second_backward_needs_the_graph_and_a_second_derivative_is_refused(kernels):
    gaussians, cameras = (kernels.move(x) for x in wide_scene(n=60))
    with torch.inference_mode():
        assert not project(gaussians, cameras, backend=kernels.backend).means2d.requires_grad
    moved, inputs = leaves(gaussians)
    loss = project(moved, cameras, backend=kernels.backend).factors.square().sum()
    first = torch.autograd.grad(loss, inputs[:3], retain_graph=True)
    with pytest.raises(RuntimeError, match="expected backward without create_graph"):
        torch.autograd.grad(loss, inputs[:3], create_graph=True)
    second = torch.autograd.grad(loss, inputs[:3])
    assert all(torch.equal(x, y) for x, y in zip(first, second, strict=True))
    with pytest.raises(RuntimeError, match="second time"):
        torch.autograd.grad(loss, inputs[:3])


def test_what_the_kernels_cannot_project_goes_to_torch(kernels, handed_over):
    gaussians, cameras = (kernels.move(x) for x in wide_scene(n=60))
    flat = cameras.extrinsics.clone()
    flat[0, 2, :3] = 0.0
    with refused(ArgumentError, name="extrinsics"):
        project(gaussians, with_camera(cameras, extrinsics=flat), backend=kernels.backend)
    project(gaussians, cameras, options=RasterOptions(near_plane=0.0), backend=kernels.backend)
    params = kernels.move(torch.tensor(LENS_PARAMS[CameraModelType.PINHOLE]))
    lens = posed(CameraModelType.PINHOLE, params, extrinsics=cameras.extrinsics)
    got, expected = (project(gaussians, lens, backend=name) for name in (kernels.backend, "torch"))
    assert torch.equal(got.means2d, expected.means2d)
    assert len(handed_over) == 3


@SELDOM_INTERPRETED
def test_a_camera_that_is_changed_before_the_backward_pass_does_not_change_it(kernels):
    gaussians, cameras = (kernels.move(x) for x in wide_scene(n=kernels.few(400, 20)))
    found = []
    for shift in (0.0, 0.5):
        means = gaussians.means.clone().requires_grad_()
        image = GaussianRenderer(backend=kernels.backend)(replace(gaussians, means=means), cameras).image
        cameras.extrinsics[0, 0, 3] += shift
        image.square().sum().backward()
        found.append(means.grad)
    assert torch.equal(*found)


# -- numbers that are extreme ----------------------------------------------------------------------------------------


@SELDOM_INTERPRETED
def test_a_color_of_exactly_zero_passes_the_gradient_and_one_below_does_not(kernels):
    gaussians, cameras = wide_scene(0, n=40)
    near = np.float32(-0.5 / SH_C0)
    around = (near, np.nextafter(near, np.float32(0)), np.nextafter(near, near - np.float32(1)))
    zeros = [x for x in around if np.float32(SH_C0) * x == -0.5]
    assert zeros
    colors = torch.tensor(zeros).repeat(40)[:40, None, None].repeat(1, 1, 3)
    colors[:, :, 1], colors[:, :, 2] = -3.0, 3.0
    got, grads, _ = list_and_gradients(replace(gaussians, colors=colors), cameras, kernels)
    expected = list_and_gradients(replace(gaussians, colors=colors), cameras)[1]
    assert got.colors[:, 1].eq(0).all()
    assert torch.allclose(grads["colors"], expected["colors"], rtol=1e-6)
    assert grads["colors"][got.gaussian_ids, 0, 0].ne(0).all()


@SELDOM_INTERPRETED
def test_tensors_with_the_negative_bit(kernels):
    """What `conj().imag` gives: a view whose numbers stand in memory with the other sign."""
    gaussians, cameras = (kernels.move(x) for x in wide_scene(1, n=60))
    lazy = {name: torch.complex(torch.zeros_like(x), -x).conj().imag for name, x in vars(gaussians).items()}
    assert all(x.is_neg() for x in lazy.values())
    found = []
    for given in (Gaussians(**lazy), gaussians):
        projected = project(given, cameras, backend=kernels.backend)
        features = composite(projected, projected.colors, backend=kernels.backend).features
        found.append([*(getattr(projected, name) for name in DIFFERENTIABLE), features])
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


@COMPILED
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", [0.0, 1e-45, 1e-30, 1e10, 1.8e19, 1e20, 1e30])
def test_extreme_values_spoil_no_other_gaussian(kernels, field, value):
    """Some Gaussians are far, huge or tiny in one field: images and gradients of all others are those of torch."""
    degree = 3 if field in ("means", "colors") else 0
    gaussians, cameras = wide_scene(degree, 400, cameras=2)
    some = getattr(gaussians, field)[5:15]
    some.copy_(some * value if field in ("means", "scales") else torch.full_like(some, value))
    image, grads = image_and_gradients(gaussians, cameras, kernels)
    expected, same = image_and_gradients(gaussians, cameras, TORCH)
    rounding = 1e-5 + 1e-6 * max(0.0, math.log2(value or 1.0)) * (field == "opacities")  # of the exponent
    torch.testing.assert_close(image, expected, rtol=1e-4, atol=rounding * float(expected.abs().max()))
    for name in FIELDS:
        got, wanted = (torch.cat([x[name][:5], x[name][15:]]) for x in (grads, same))
        assert got.isfinite().all()
        torch.testing.assert_close(got, wanted, rtol=1e-3, atol=1e-5 * float(wanted.abs().max()))


def image_and_gradients(gaussians, cameras, target):
    inputs = {name: target.move(getattr(gaussians, name)).clone().requires_grad_() for name in FIELDS}
    image = GaussianRenderer(backend=target.backend)(Gaussians(**inputs), target.move(cameras)).image
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    (image * target.move(weights)).sum().backward()
    return image.detach().cpu(), {name: value.grad.cpu() for name, value in inputs.items()}
