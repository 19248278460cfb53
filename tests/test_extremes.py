"""Stiff and hostile inputs: needles, opacities above 1, ties, values that are not finite."""

import dataclasses
import itertools
import math

import pytest
import torch
from oracles import enumerate_drops, mpmath_pixels, near_threshold, pinhole, random_camera, random_gaussians

import kgs.reference
from kgs import GaussianModel, GaussianRenderer, Gaussians

FIELDS = ("means", "quats", "scales", "opacities", "colors")
OUTPUTS = ("image", "alpha", "depth", "median_depth")


def leaves(gaussians):
    inputs = [getattr(gaussians, name).detach().clone().requires_grad_() for name in FIELDS]
    return Gaussians(*inputs), inputs


def one(scales, quat=(0.9, 0.2, -0.3, 0.4), mean=(0.05, -0.03, 4.0), opacity=0.8, dtype=torch.float32):
    values = ([mean], [quat], [scales], [opacity], [[0.3, 0.6, 0.9]])
    return Gaussians(*(torch.tensor(value, dtype=torch.float64).to(dtype) for value in values))


# --- degenerate footprints (A4) ---------------------------------------------------------------------------------


@pytest.mark.parametrize("largest", [0.0, 1e-45, 1e-30, 1e-6, 1.0, 1e6])
def test_scales_from_nothing_to_everything(largest):
    camera = pinhole(9, 11, (10.0, 10.0), dtype=torch.float32)
    sizes = [size for size in (0.0, 1e-45, 1e-30, 1e-6, 1.0, 1e6) if size <= largest]
    pixels = [(4, 5), (4, 6), (0, 0)]
    for pair in itertools.combinations_with_replacement(sizes, 2):
        for scales in {(largest, *pair), (*pair, largest)}:
            gaussians, inputs = leaves(one(scales))
            image = GaussianRenderer()(gaussians, camera).image
            assert image.isfinite().all(), scales
            expected = torch.tensor(mpmath_pixels(gaussians, camera, pixels), dtype=torch.float64)
            got = torch.stack([image[0, :, row, column] for row, column in pixels])
            skipped = (expected < 0.9 / 255) & (got == 0)  # below the threshold of alpha
            assert ((got - expected).abs() * ~skipped).max() <= 2e-3, scales
            image.square().sum().backward()
            assert all(x.grad.isfinite().all() for x in inputs), scales


# 5 times what the factor route with LDL^T reaches in float32; the plain covariance loses 5e-5, 4e-3, 19 and 3e6
@pytest.mark.parametrize(("ratio", "bound"), [(1e2, 5e-6), (1e3, 2e-5), (1e4, 1.5e-4), (1e5, 1.5e-3), (1e6, 8e-3)])
@pytest.mark.parametrize("pancake", [False, True])
def test_needles_and_pancakes(ratio, bound, pancake):
    camera = pinhole(24, 24, (500.0, 500.0), dtype=torch.float32)
    pixels = [(3, 4), (11, 12), (12, 11), (20, 17), (5, 19)]
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        quat = torch.randn(4, generator=generator).tolist()
        small = 0.02 * 2.0 / 500
        scales = (small * ratio, small * ratio if pancake else small, small)
        gaussians, inputs = leaves(one(scales, quat, mean=(0.001, -0.0015, 2.0)))
        image = GaussianRenderer(alpha_threshold=0, transmittance_stop=0)(gaussians, camera).image
        expected = torch.tensor(mpmath_pixels(gaussians, camera, pixels), dtype=torch.float64)
        got = torch.stack([image[0, :, row, column] for row, column in pixels])
        assert (got - expected).abs().max() <= bound
        image.square().sum().backward()
        assert all(x.grad.isfinite().all() for x in inputs)


# 5 times what automatic differentiation of the factor route reaches; a product with the conic loses all digits at 1e5
@pytest.mark.parametrize(("ratio", "bound"), [(1e3, 6e-4), (1e5, 1.4e-3), (1e6, 1.4e-3)])
@pytest.mark.parametrize("pancake", [False, True])
def test_gradients_of_needles_and_pancakes(ratio, bound, pancake):
    generator = torch.Generator().manual_seed(0)
    n, small = 40, 0.02 * 2.0 / 500
    scales = torch.tensor([small * ratio, small * ratio if pancake else small, small], dtype=torch.float64)
    start = Gaussians(
        means=torch.tensor([0.0, 0.0, 2.0]) + 0.02 * torch.randn(n, 3, generator=generator),
        quats=torch.randn(n, 4, generator=generator),
        scales=scales.float().repeat(n, 1),
        opacities=torch.full((n,), 0.3),
        colors=torch.rand(n, 3, generator=generator),
    )
    weights = torch.randn(1, 3, 24, 24, generator=generator, dtype=torch.float64)
    single, inputs = leaves(start)
    double, exact = leaves(Gaussians(*(getattr(start, name).double() for name in FIELDS)))
    exactly = GaussianRenderer(alpha_threshold=0, transmittance_stop=0)
    for gaussians, dtype in ((single, torch.float32), (double, torch.float64)):
        image = exactly(gaussians, pinhole(24, 24, (500.0, 500.0), dtype=dtype)).image
        (image * weights.to(dtype)).sum().backward()
    for name, x, y in zip(FIELDS, inputs, exact, strict=True):
        assert (x.grad - y.grad).abs().max() <= bound * y.grad.abs().max(), name


@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_no_needle_has_a_determinant_below_what_is_possible(ratio):
    generator = torch.Generator().manual_seed(1)
    n = 2000
    scales = torch.tensor([0.02, 0.02, 0.02 * ratio]) * 2 / 500
    needles = Gaussians(
        means=torch.tensor([0.0, 0.0, 2.0]).repeat(n, 1) + 0.02 * torch.randn(n, 3, generator=generator),
        quats=torch.randn(n, 4, generator=generator),
        scales=scales.repeat(n, 1),
        opacities=torch.full((n,), 0.01),
        colors=torch.rand(n, 3, generator=generator),
    )
    projected = GaussianRenderer()(needles, pinhole(24, 24, (500.0, 500.0), dtype=torch.float32)).projected
    a, b, c = projected.conics.double().unbind(1)
    assert len(projected) > 0.9 * n  # the others are beside the image
    assert projected.conics.isfinite().all()
    assert (a > 0).all()
    assert (c > 0).all()
    # eigenvalues of the inverse lie in (0, 1 / 0.3]
    assert (a + c <= 2 / 0.3 * 1.001).all()
    assert (a * c - b * b >= -1e-6 * a * c).all()


def test_a_gaussian_wider_than_the_world_is_a_veil():
    for scale in (1e3, 1e6, 1e8):
        image = GaussianRenderer()(one((scale,) * 3), pinhole(20, 30, (20.0, 20.0), dtype=torch.float32)).image
        assert (image[0] - 0.8 * torch.tensor([0.3, 0.6, 0.9])[:, None, None]).abs().max() <= 1e-4


# --- many pairs (A6) --------------------------------------------------------------------------------------------


def test_screen_filling_gaussians_under_a_budget():
    n = 300
    gaussians = random_gaussians(n, 0, torch.float32, None, opacities=(0.005, 0.03))
    gaussians = dataclasses.replace(gaussians, scales=gaussians.scales * 30)
    camera = random_camera(96, 96, 0, torch.float32)
    results = []
    for max_bytes in (2**30, 2**20):
        g, inputs = leaves(gaussians)
        image = GaussianRenderer(max_bytes=max_bytes)(g, camera).image
        image.square().sum().backward()
        results.append([image.detach(), *(x.grad for x in inputs)])
    assert torch.equal(results[0][0], results[1][0])
    for a, b in zip(*results, strict=True):
        assert (a - b).abs().max() <= 1e-5 * a.abs().max()
    with pytest.raises(ValueError, match="max_bytes"):
        GaussianRenderer(max_bytes=80 * n)(gaussians, camera)


# --- opacities above 1 (A8) -------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("tile_size", [4, 16])
def test_an_opacity_above_one_is_drawn_to_where_its_own_alpha_ends(tile_size, dtype):
    # 1.25, as DropGaussian makes it at a rate of 0.2: alpha reaches 1/255 at 3.395 sigma, beyond the 3.33 of opacity 1
    camera = pinhole(101, 101, (100.0, 100.0), dtype=dtype)
    gaussians = one((0.4, 0.4, 0.4), mean=(0.0, 0.0, 4.0), opacity=1.25, dtype=dtype)
    alpha = GaussianRenderer(tile_size=tile_size)(gaussians, camera, outputs=("alpha",)).alpha[0, 0].double()
    y, x = torch.meshgrid(torch.arange(101.0) - 50, torch.arange(101.0) - 50, indexing="ij")
    squared = (x * x + y * y).double() / (100 + 0.3)
    raw = 1.25 * torch.exp(-squared / 2)
    expected = torch.where(raw >= 1 / 255, raw.clamp(max=0.99), 0.0)
    certain = (raw * 255 - 1).abs() > 1e-5
    assert ((alpha - expected).abs() * certain).max() <= (2e-6 if dtype == torch.float32 else 1e-12)
    ring = (squared.sqrt() > 3.34) & (squared.sqrt() < 3.39)
    assert ring.any()
    assert (alpha[ring] > 0).all()
    assert (alpha[squared.sqrt() > 3.4] == 0).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_opacities_above_one_do_not_depend_on_tiles_and_are_the_reference(seed):
    gaussians = random_gaussians(60, seed, opacities=(0.9, 2.5))
    camera = random_camera(33, 41, seed)
    certain = ~near_threshold(gaussians, camera)
    expected = kgs.reference.render(gaussians, camera)
    for tile_size in (4, 8, 32):
        image = GaussianRenderer(tile_size=tile_size)(gaussians, camera).image
        assert ((image - expected).abs() * certain).max() <= 1e-11


def test_expectation_over_all_masks_is_the_image_while_nothing_is_clamped():
    gaussians, camera = random_gaussians(6, 2, opacities=(0.05, 0.75)), random_camera(16, 16, 2)
    renderer = GaussianRenderer(alpha_threshold=0, transmittance_stop=0)
    full = renderer(gaussians, camera, outputs=("image",)).image

    def render(factors):
        return renderer(dataclasses.replace(gaussians, opacities=gaussians.opacities * factors), camera).image

    assert (enumerate_drops(6, 0.2, render) - full).abs().max() <= 1e-14
    assert (render(torch.tensor([1, 1, 1, 1, 1, 0]).double()) - full).abs().max() > 1e-3


def test_expectation_of_a_clamped_alpha_is_known():
    # o = 0.99, rate 0.2: kept it is 1.2375, clamped to 0.99, so the mean alpha at the peak is 0.8 * 0.99
    gaussians = one((1.0, 1.0, 1.0), mean=(0.0, 0.0, 4.0), opacity=0.99, dtype=torch.float64)
    camera = pinhole(3, 3, (10.0, 10.0))

    def peak(factors):
        thinned = dataclasses.replace(gaussians, opacities=gaussians.opacities * factors)
        return GaussianRenderer()(thinned, camera, outputs=("alpha",)).alpha[0, 0, 1, 1]

    assert enumerate_drops(1, 0.2, peak).item() == pytest.approx(0.8 * 0.99, abs=1e-12)


# --- ties (A11) -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_depths_are_in_the_order_of_the_index(dtype):
    gaussians = random_gaussians(200, 0, dtype, None)
    means = gaussians.means.clone()
    means[:, 2] = torch.tensor([3.0, 4.0, 3.5, 4.0], dtype=dtype).repeat(50)
    gaussians = dataclasses.replace(gaussians, means=means)
    camera = pinhole(24, 32, (32.0, 32.0), dtype=dtype)
    renderer = GaussianRenderer(alpha_threshold=0, transmittance_stop=0)
    image = renderer(gaussians, camera).image
    expected = kgs.reference.render(gaussians, camera, None, 0.0, 0.0)
    assert (image - expected).abs().max() <= (1e-5 if dtype == torch.float32 else 1e-12)
    assert all(torch.equal(renderer(gaussians, camera).image, image) for _ in range(4))
    backwards = Gaussians(*(getattr(gaussians, name).flip(0) for name in FIELDS))
    assert (renderer(backwards, camera).image - image).abs().max() > 1e-2  # the order is visible


def test_tied_layers_of_one_colour_may_be_exchanged():
    gaussians = random_gaussians(100, 0, sh_degree=None)
    means = gaussians.means.clone()
    means[:, 2] = 4.0
    gaussians = dataclasses.replace(gaussians, means=means, colors=gaussians.colors[:1].expand(100, 3))
    camera, renderer = pinhole(24, 32, (32.0, 32.0)), GaussianRenderer(alpha_threshold=0, transmittance_stop=0)
    backwards = Gaussians(*(getattr(gaussians, name).flip(0) for name in FIELDS))
    assert (renderer(gaussians, camera).image - renderer(backwards, camera).image).abs().max() <= 1e-14


# --- values that are not finite (A15) ---------------------------------------------------------------------------


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
