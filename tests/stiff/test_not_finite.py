"""Values that are not finite, or saturated."""

import dataclasses
import math

import pytest
import torch
from factories import FIELDS, leaves, pinhole, random_camera, random_gaussians
from stiff_checks import one

from kgs import GaussianModel, GaussianRenderer, Gaussians

pytestmark = pytest.mark.usefixtures("each_backend")

OUTPUTS = ("image", "alpha", "depth", "median_depth")


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", FIELDS)
def test_a_gaussian_that_is_not_finite_is_as_if_it_were_not_there(name, bad):
    gaussians, camera = random_gaussians(40, 0, torch.float32, 1), random_camera(24, 32, 0, torch.float32)
    spoilt = getattr(gaussians, name).clone()
    spoilt.view(40, -1)[17, -1] = bad
    others = torch.arange(40) != 17
    without, inputs = leaves(Gaussians(*(getattr(gaussians, field)[others] for field in FIELDS)))
    broken, broken_inputs = leaves(dataclasses.replace(gaussians, **{name: spoilt}))
    expected = GaussianRenderer()(without, camera, outputs=OUTPUTS)
    out = GaussianRenderer()(broken, camera, outputs=OUTPUTS)
    for field in OUTPUTS:
        assert torch.equal(getattr(out, field), getattr(expected, field))
    assert int(out.projected.num_nonfinite) == 1
    assert int(expected.projected.num_nonfinite) == 0
    for result in (out, expected):
        (result.image.square().sum() + result.depth.sum()).backward()
    for a, b in zip(broken_inputs, inputs, strict=True):
        assert torch.equal(a.grad[others], b.grad)
        assert not a.grad[17].any()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_strong_gaussian_beside_the_image_is_drawn_whatever_else_is_spoilt(bad):
    # sigma 5 px, 20 px left of the image: alpha there is still 0.03 at an opacity of 100
    strong = one((1.0, 1.0, 1.0), mean=(-6.1, 0.0, 4.0), opacity=100.0, dtype=torch.float64)
    spoilt = one((0.1, 0.1, 0.1), opacity=bad, dtype=torch.float64)
    both = Gaussians(*(torch.cat([getattr(strong, name), getattr(spoilt, name)]) for name in FIELDS))
    camera = pinhole(9, 21, (20.0, 20.0))
    expected = GaussianRenderer()(strong, camera).image
    assert expected.max() > 0.01
    assert torch.equal(GaussianRenderer()(both, camera).image, expected)


def test_finite_values_whose_sum_overflows_are_finite():
    # the Gaussian is far outside the image, but it is counted as what it is
    gaussians = random_gaussians(10, 0, torch.float32, None)
    colors = gaussians.colors.clone()
    colors[4] = 3e38
    means = gaussians.means.clone()
    means[4] = torch.tensor([1e4, 0.0, 4.0])
    out = GaussianRenderer()(
        dataclasses.replace(gaussians, means=means, colors=colors), random_camera(9, 9, 0, torch.float32)
    )
    assert int(out.projected.num_nonfinite) == 0
    assert out.image.isfinite().all()


LOG_SCALES = [-math.inf, -100.0, -44.0, 0.0, 44.0, 88.0, 89.0, math.inf]
LOGITS = [-1e4, -104.0, -17.0, 17.0, 1e4]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_saturated_scales_and_opacities_are_drawn_or_left_out(dtype):
    pairs = torch.tensor([(s, o) for s in LOG_SCALES for o in LOGITS], dtype=torch.float64).to(dtype)
    n = len(pairs)
    generator = torch.Generator().manual_seed(0)
    model = GaussianModel(
        means=torch.rand(n, 3, generator=generator).to(dtype) + torch.tensor([-0.5, -0.5, 3.0], dtype=dtype),
        quats=torch.randn(n, 4, generator=generator).to(dtype),
        log_scales=pairs[:, :1].expand(n, 3).clone(),
        opacity_logits=pairs[:, 1].clone(),
        sh_dc=torch.rand(n, 1, 3, generator=generator).to(dtype),
        sh_rest=torch.zeros(n, 0, 3, dtype=dtype),
    )
    out = GaussianRenderer()(model(), pinhole(9, 11, (10.0, 10.0), dtype=dtype))
    out.image.square().sum().backward()
    overflow = float(torch.finfo(dtype).max)
    beyond = int((pairs[:, 0].exp() > overflow).sum())
    assert int(out.projected.num_nonfinite) == beyond >= 5
    assert torch.isfinite(out.image).all()
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh_dc"):
        finite = torch.isfinite(model.get_parameter(name).grad.reshape(n, -1)).all(1)
        assert finite[pairs[:, 0].exp() <= overflow].all(), name
