"""Numbers that are not finite, overflow or are saturated. That a Gaussian with one is left out is in `test_bits`."""

import dataclasses
import math

import pytest
import torch
from factories import FIELDS, join, pinhole, random_camera, random_gaussians, replace
from kornia.geometry.camera import PinholeCamera
from projection_checks import PACKED, wide_scene
from stiff_checks import one

from kgs import GaussianModel, GaussianRenderer, Gaussians, composite, pinhole_cameras, project, rasterization

pytestmark = pytest.mark.usefixtures("each_backend")


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_strong_gaussian_beside_the_image_is_drawn_whatever_else_is_spoilt(bad):
    # sigma 5 px, 20 px left of the image: alpha there is still 0.03 at an opacity of 100
    strong = one((1.0, 1.0, 1.0), mean=(-6.1, 0.0, 4.0), opacity=100.0, dtype=torch.float64)
    spoilt = one((0.1, 0.1, 0.1), opacity=bad, dtype=torch.float64)
    camera = pinhole(9, 21, (20.0, 20.0))
    expected = GaussianRenderer()(strong, camera).image
    assert expected.max() > 0.01
    assert torch.equal(GaussianRenderer()(join(strong, spoilt), camera).image, expected)


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


SHAPES = {"ball": (1.0, 1.0, 1.0), "needle": (1.0, 1e-12, 1e-12), "pancake": (1.0, 1.0, 1e-12)}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("exponent", [-30, *range(6, 38)])
def test_gradients_are_finite_at_every_size_of_the_footprint(shape, exponent):
    """To 1e37 world units at focal length 30 and depth 4, among ordinary Gaussians."""
    gaussians = random_gaussians(12, 0, torch.float32, 1, image_size=32)
    gaussians.scales[5] = 10.0**exponent * torch.tensor(SHAPES[shape])
    camera = pinhole(24, 32, 30.0, dtype=torch.float32)
    values = [getattr(gaussians, name) for name in FIELDS]
    inputs = [x.clone().requires_grad_() for x in (*values, camera.extrinsics, camera.intrinsics)]
    posed = PinholeCamera(inputs[6], inputs[5], camera.height, camera.width)
    out = GaussianRenderer()(Gaussians(*inputs[:5]), posed, outputs=("image", "depth"))
    assert int(out.projected.num_nonfinite) == 0
    assert all(getattr(out.projected, name).isfinite().all() for name in PACKED)
    assert out.image.isfinite().all()
    (out.image.square().sum() + out.depth.sum()).backward()
    for name, x in zip((*FIELDS, "extrinsics", "intrinsics"), inputs, strict=True):
        assert x.grad.isfinite().all(), name
    assert inputs[5].grad.any()
    if 5 not in out.projected.gaussian_ids.tolist():
        assert exponent > 8, "what fits is drawn"
        assert all(not x.grad[5].any() for x in inputs[:5])


def test_a_gaussian_wider_than_the_world_is_a_veil():
    for scale in (1e3, 1e6, 1e8):
        image = GaussianRenderer()(one((scale,) * 3), pinhole(20, 30, (20.0, 20.0), dtype=torch.float32)).image
        assert (image[0] - 0.8 * torch.tensor([0.3, 0.6, 0.9])[:, None, None]).abs().max() <= 1e-4


def test_a_far_gaussian_has_the_colour_of_its_direction():
    """As one on the same ray at a distance of 1e8, whose squares do not overflow."""
    intrinsics = torch.tensor([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
    camera = pinhole_cameras(torch.eye(4), intrinsics, width=32, height=24)
    colors = torch.randn(1, 4, 3, generator=torch.Generator().manual_seed(0))

    def seen(z):
        far = one((z, z, z), mean=(0.2 * z, 0.1 * z, z))
        return project(replace(far, colors=colors), camera).colors

    torch.testing.assert_close(seen(1e25), seen(1e8), rtol=1e-5, atol=1e-6)


# -- compositing -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [1e20, 1e30, torch.inf, torch.nan])
def test_footprints_that_are_not_finite_are_not_composited(value):
    projected = project(*wide_scene(n=60, cameras=2))
    factors, opacities = projected.factors.clone(), projected.opacities.clone()
    factors[5:10] = torch.eye(2, 3) * value
    opacities[5:10] = 0.0
    features = torch.rand(len(factors), 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    got = composite(dataclasses.replace(projected, factors=factors), features, median_depth=True)
    without = composite(dataclasses.replace(projected, opacities=opacities), features, median_depth=True)
    for name in ("features", "transmittance", "median_depth"):
        torch.testing.assert_close(getattr(got, name), getattr(without, name), rtol=0, atol=1e-6)
    (gradient,) = torch.autograd.grad(got.features.sum(), [features])
    assert gradient.isfinite().all()
    assert not gradient[5:10].any()


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_depth_that_is_not_finite_stays_in_its_own_pixels(value):
    projected = project(*wide_scene(n=60))
    farthest = int(projected.depths.argmax())
    depths = projected.depths.clone()
    depths[farthest] = value
    plain, found = (
        composite(dataclasses.replace(projected, depths=x), projected.colors, median_depth=True).median_depth
        for x in (projected.depths, depths)
    )
    other = plain != projected.depths[farthest]
    assert torch.equal(found[other], plain[other])


# -- gsplat's call ---------------------------------------------------------------------------------------------------


def call(gaussians, views, colors, covars=None):
    """Colours of each camera; with covariances instead of quaternions and scales where they are given."""
    shape = {"covars": covars, "quats": None, "scales": None} if covars is not None else {}
    given = vars(gaussians) | {"colors": colors} | shape
    k = views.intrinsics[:, :3, :3]
    return rasterization(**given, viewmats=views.extrinsics, Ks=k, width=32, height=24)[0]


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("index", [(0, 7, 0), (1, 7, 0), (7, 0, 1), (7, 0, 0), (7, 1, 1), (7, 2, 2)])
def test_a_colour_of_one_camera_or_a_covariance_that_is_not_finite_leaves_its_gaussian_out(index, value):
    gaussians, views = random_gaussians(60, 0, torch.float32, None, 32), random_camera(24, 32, 0, torch.float32)
    views = PinholeCamera(*(torch.cat([x, x]) for x in (views.intrinsics, views.extrinsics, views.height, views.width)))
    colors = torch.rand(2, 60, 3, generator=torch.Generator().manual_seed(0))
    covars = torch.diag_embed(gaussians.scales**2)
    rest = torch.arange(60) != 7
    expected = call(gaussians[rest], views, colors[:, rest], covars[rest])
    spoilt = covars if index[0] == 7 else colors
    spoilt[index] = value
    spoilt.requires_grad_()
    renders = call(gaussians, views, colors, covars)
    assert torch.allclose(renders, expected, atol=1e-5)
    renders.square().sum().backward()
    gradient = spoilt.grad if index[0] == 7 else spoilt.grad.transpose(0, 1)
    assert not gradient[7].any()
    assert gradient.isfinite().all()
    assert gradient[rest].any()
