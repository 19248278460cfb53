"""The renderer inside other people's programs: compilers, other defaults, transforms of functions."""

from dataclasses import replace

import pytest
import torch
from factories import FIELDS, OUTPUTS, leaves, other_defaults, posed, random_camera, random_gaussians
from kornia.sensors.camera import CameraModelType

import kgs
from kgs import GaussianRenderer, Gaussians

SIZE = (24, 32)


@pytest.mark.usefixtures("each_backend")
@pytest.mark.parametrize("kind", ["pinhole", "fisheye"])
def test_tensors_decide_the_device_whatever_the_default_is(kind):
    gaussians = random_gaussians(60, 0, torch.float32, 3)
    camera = random_camera(*SIZE, 0, torch.float32)
    if kind == "fisheye":
        camera = posed(CameraModelType.KANNALA_BRANDT_K3, dtype=torch.float32)
    given, inputs = leaves(gaussians)
    expected = GaussianRenderer()(given, camera, outputs=(*OUTPUTS, "normal"))
    expected.image.square().sum().backward()
    values = [getattr(gaussians, name).clone() for name in FIELDS]
    views = [random_camera(*SIZE, 0, torch.float32).extrinsics, torch.tensor([[[32.0, 0, 16], [0, 32, 12], [0, 0, 1]]])]
    options = {"width": 32, "height": 24, "sh_degree": 3, "render_mode": "RGB+ED"}
    expected_call = kgs.rasterization(*values, *views, **options)
    with other_defaults():
        other = Gaussians(*(getattr(gaussians, name).requires_grad_() for name in FIELDS))
        out = GaussianRenderer()(other, camera, outputs=(*OUTPUTS, "normal"))
        out.image.square().sum().backward()
        call = kgs.rasterization(*values, *views, **options)
    assert all(torch.equal(a, b) for a, b in zip(call[:2], expected_call[:2], strict=True))
    for name in (*OUTPUTS, "normal"):
        assert torch.equal(getattr(out, name), getattr(expected, name))
    for name, value in zip(FIELDS, inputs, strict=True):
        assert torch.equal(getattr(other, name).grad, value.grad)


def test_transforms_of_functions_are_errors():
    gaussians, camera = random_gaussians(5, 0), random_camera(8, 8, 0)

    def loss(opacities, background=None):
        given = Gaussians(gaussians.means, gaussians.quats, gaussians.scales, opacities, gaussians.colors)
        return GaussianRenderer()(given, camera, background).image.square().sum()

    with pytest.raises(RuntimeError):
        torch.func.vmap(loss)(gaussians.opacities[None])
    with pytest.raises((RuntimeError, NotImplementedError)):
        torch.func.jvp(loss, (gaussians.opacities,), (torch.ones(5).double(),))
    leaf = gaussians.opacities.clone().requires_grad_()
    value = loss(leaf)
    with pytest.raises(RuntimeError):
        torch.autograd.grad(value, leaf, torch.ones(3).double(), is_grads_batched=True)
    for background in (None, torch.ones(3).double()):
        with pytest.raises(RuntimeError, match="second derivative"):
            torch.autograd.grad(loss(leaf, background), leaf, create_graph=True)


@pytest.mark.usefixtures("each_backend")
@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.jacrev])
def test_transforms_are_named(transform):
    gaussians, camera = random_gaussians(5, 0).to(torch.float32), random_camera(8, 8, 0, torch.float32)

    def loss(colors):
        return GaussianRenderer()(replace(gaussians, colors=colors), camera).image.sum()

    with pytest.raises(RuntimeError, match="transform"):
        transform(loss)(gaussians.colors)
