"""Footprints that float32 cannot hold are left out, before they spoil a gradient."""

import pytest
import torch
from factories import FIELDS, pinhole, random_gaussians
from kornia.geometry.camera import PinholeCamera

from kgs import GaussianRenderer, Gaussians

pytestmark = pytest.mark.usefixtures("each_backend")

SHAPES = {"ball": (1.0, 1.0, 1.0), "needle": (1.0, 1e-12, 1e-12), "pancake": (1.0, 1.0, 1e-12)}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("exponent", range(6, 38))
def test_gradients_are_finite_at_every_size_of_the_footprint(shape, exponent):
    """From a million to 1e38 world units at focal length 30 and depth 4, among ordinary Gaussians."""
    gaussians = random_gaussians(12, 0, torch.float32, 1, image_size=32)
    scales = gaussians.scales.clone()
    scales[5] = 10.0**exponent * torch.tensor(SHAPES[shape])
    camera = pinhole(24, 32, 30.0, dtype=torch.float32)
    inputs = [x.clone() for x in (gaussians.means, gaussians.quats, scales, gaussians.opacities, gaussians.colors)]
    inputs = [x.requires_grad_() for x in (*inputs, camera.extrinsics, camera.intrinsics)]
    posed = PinholeCamera(inputs[6], inputs[5], camera.height, camera.width)
    out = GaussianRenderer()(Gaussians(*inputs[:5]), posed, outputs=("image", "depth"))
    assert out.image.isfinite().all()
    (out.image.square().sum() + out.depth.sum()).backward()
    for name, x in zip((*FIELDS, "extrinsics", "intrinsics"), inputs, strict=True):
        assert x.grad.isfinite().all(), name
    assert inputs[5].grad.any()
    if 5 not in out.projected.gaussian_ids.tolist():
        assert exponent > 8, "what fits is drawn"
        assert all(not x.grad[5].any() for x in inputs[:5])
