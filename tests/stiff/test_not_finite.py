"""Values that are not finite, saturated or at the border of what is drawn."""

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


def test_opacities_a_camera_that_are_not_finite():
    gaussians = random_gaussians(40, 0, torch.float32, 1)
    opacities = gaussians.opacities.clone()
    opacities[[3, 20]] = torch.tensor([math.nan, math.inf])
    camera = random_camera(24, 32, 0, torch.float32)
    out = GaussianRenderer()(dataclasses.replace(gaussians, opacities=opacities[None]), camera)
    assert out.image.isfinite().all()
    assert int(out.projected.num_nonfinite) == 2


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


@pytest.mark.parametrize("z", [-5.0, -1e-30, 0.0, 0.01, 0.0100001])
def test_the_near_plane_itself_is_not_seen(z):
    gaussians, inputs = leaves(one((0.001, 0.002, 0.003), mean=(0.0, 0.0, z), dtype=torch.float64))
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    image = GaussianRenderer()(gaussians, pinhole(5, 5, (5.0, 5.0)), background).image
    image.sum().backward()
    assert all(x.grad.isfinite().all() for x in inputs)
    if z <= 0.01:
        assert torch.equal(image, background[None, :, None, None].expand_as(image))
        assert not any(x.grad.any() for x in inputs)
    else:
        assert (image != background[None, :, None, None]).any()
        assert image.isfinite().all()


@pytest.mark.parametrize("quat", [(0.0, 0.0, 0.0, 0.0), (1e-30, 0.0, 0.0, 0.0), (0.0, 1e30, -1e30, 0.0)])
def test_quaternions_of_any_norm(quat):
    gaussians, inputs = leaves(one((0.1, 0.2, 0.3), quat))
    camera = pinhole(9, 9, (20.0, 20.0), dtype=torch.float32)
    image = GaussianRenderer()(gaussians, camera).image
    peak = max(map(abs, quat))
    unit = tuple(x / peak for x in quat) if peak else (1.0, 0.0, 0.0, 0.0)
    assert (image - GaussianRenderer()(one((0.1, 0.2, 0.3), unit), camera).image).abs().max() <= 1e-6
    image.square().sum().backward()
    assert all(x.grad.isfinite().all() for x in inputs)
    if not peak:
        assert not inputs[1].grad.any()


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
