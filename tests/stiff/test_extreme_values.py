"""Values that overflow when they are squared, or are not finite, on each backend."""

import dataclasses

import pytest
import torch
from projection_checks import wide_scene

from kgs import Gaussians, composite, pinhole_cameras, project


@pytest.mark.usefixtures("each_backend")
def test_a_far_gaussian_has_the_colour_of_its_direction():
    """As one on the same ray at a distance of 1e8, whose squares do not overflow."""
    colors = torch.randn(1, 4, 3, generator=torch.Generator().manual_seed(0))
    intrinsics = torch.tensor([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
    camera = pinhole_cameras(torch.eye(4), intrinsics, width=32, height=24)

    def seen(distance):
        ray = torch.tensor([[0.2, 0.1, 1.0]])
        gaussians = Gaussians(
            distance * ray, torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), distance), torch.ones(1), colors
        )
        return project(gaussians, camera).colors

    torch.testing.assert_close(seen(1e25), seen(1e8), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("value", [1e20, 1e30, torch.inf, torch.nan])
def test_footprints_that_are_not_finite_are_not_composited(value, each_backend):
    projected = project(*wide_scene(n=60, cameras=2))
    factors = projected.factors.detach().clone()
    factors[5:10] = torch.eye(2, 3) * value
    features = torch.rand(len(factors), 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    opacities = projected.opacities.detach().clone()
    opacities[5:10] = 0.0
    got = composite(dataclasses.replace(projected, factors=factors), features, median_depth=True)
    without = composite(dataclasses.replace(projected, opacities=opacities), features, median_depth=True)
    for name in ("features", "transmittance", "median_depth"):
        torch.testing.assert_close(getattr(got, name), getattr(without, name), rtol=0, atol=1e-6)
    (gradient,) = torch.autograd.grad(got.features.sum(), [features])
    assert gradient.isfinite().all()
    assert not gradient[5:10].any()


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_depth_that_is_not_finite_stays_in_its_own_pixels(value, each_backend):
    projected = project(*wide_scene(n=60))
    farthest = int(projected.depths.argmax())
    depths = projected.depths.detach().clone()
    plain = composite(projected, projected.colors, median_depth=True).median_depth
    depths[farthest] = value
    found = composite(dataclasses.replace(projected, depths=depths), projected.colors, median_depth=True).median_depth
    other = plain != projected.depths[farthest]
    assert torch.equal(found[other], plain[other])
