"""The renderer inside other people's programs: transforms of functions."""

from dataclasses import replace

import pytest
import torch
from factories import FIELDS, random_camera, random_gaussians

from kgs import GaussianRenderer, Gaussians


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
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.jacrev])
def test_reverse_transforms_are_refused_by_name(transform, field):
    gaussians, camera = random_gaussians(5, 0).to(torch.float32), random_camera(8, 8, 0, torch.float32)

    def loss(values):
        return GaussianRenderer()(replace(gaussians, **{field: values}), camera).image.sum()

    with pytest.raises(RuntimeError, match="torch.func"):
        transform(loss)(getattr(gaussians, field))
