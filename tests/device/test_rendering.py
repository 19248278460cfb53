"""Rendering on the device under test against the dense float64 reference and the CPU."""

import dataclasses

import pytest
import torch
from factories import FIELDS, LENS_PARAMS, OUTPUTS, leaves, posed, random_gaussians, random_scene
from oracles import near_threshold

import kgs
import kgs.reference
from kgs import GaussianRenderer, backends
from kgs.bench import extremes

BOUNDS = {torch.float32: 1e-5, torch.float64: 1e-11}
DTYPES = pytest.mark.parametrize("dtype", list(BOUNDS))


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_auto_takes_the_kernels():
    """Else all tests of this folder would pass in torch."""
    assert backends.resolve("auto", torch.device("cuda")) == "triton"


def cotangents(*values):
    generator = torch.Generator().manual_seed(1)
    return [torch.randn(v.shape, generator=generator, dtype=torch.float64).to(v) for v in values]


def assert_near(got, expected, bound):
    """Within `bound` of the largest value."""
    assert got.device.type == expected.device.type == "cpu"
    assert (got.double() - expected.double()).abs().max() <= bound * expected.double().abs().max().clamp_min(1e-30)


@DTYPES
@pytest.mark.parametrize("sh_degree", [None, 0, 3])
def test_all_outputs_are_those_of_the_reference(device, there, dtype, sh_degree):
    gaussians, camera = random_scene(0, dtype, 300, (40, 56), sh_degree)
    out = GaussianRenderer()(there(gaussians), there(camera), outputs=OUTPUTS)
    exact = dataclasses.replace(gaussians, **{name: getattr(gaussians, name).double() for name in FIELDS})
    wide = kgs.pinhole_cameras(camera.extrinsics.double(), camera.intrinsics.double(), 56, 40)
    certain = ~near_threshold(exact, wide)
    expected = kgs.reference.render(exact, wide)
    assert out.image.device.type == device.type
    assert ((out.image.cpu().double() - expected).abs() * certain).max() <= BOUNDS[dtype]
    plain = GaussianRenderer(backend="torch")(gaussians, camera, outputs=OUTPUTS)
    for name in ("alpha", "depth", "median_depth"):
        got, want = getattr(out, name).cpu(), getattr(plain, name)
        assert ((got - want).abs() * certain).max() <= 20 * BOUNDS[dtype], name


@DTYPES
def test_gradients_of_gaussians_pose_and_intrinsics(device, there, dtype):
    gaussians, camera = random_scene(1, torch.float64, 200, (40, 56), 3, cameras=2)

    def gradients(move, kind):
        moved, inputs = leaves(move(gaussians.to(kind)))
        matrices = [move(x.to(kind)).requires_grad_() for x in (camera.extrinsics, camera.intrinsics)]
        out = GaussianRenderer(backend="auto" if kind == dtype else "torch")(
            moved, kgs.pinhole_cameras(*matrices, width=56, height=40), outputs=("image", "alpha", "depth")
        )
        values = [out.image, out.alpha, out.depth]
        return [x.cpu() for x in torch.autograd.grad(values, [*inputs, *matrices], cotangents(*values))]

    expected = gradients(lambda x: x, torch.float64)
    for got, want in zip(gradients(there, dtype), expected, strict=True):
        assert_near(got, want, 3e-3 if dtype == torch.float32 else 1e-9)


@pytest.mark.parametrize("kind", list(LENS_PARAMS), ids=lambda kind: kind.name)
def test_every_lens(device, there, kind):
    gaussians = random_gaussians(100, 2, torch.float64, 1)
    expected = GaussianRenderer()(gaussians, posed(kind)).image
    assert_near(GaussianRenderer()(there(gaussians), there(posed(kind))).image.cpu(), expected, 1e-11)


def test_features_normals_masks_of_dropped_gaussians_and_backgrounds(device, there):
    gaussians, camera = random_scene(3, torch.float64, 150, sh_degree=None, cameras=2)
    features = torch.rand(150, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    opacities = gaussians.opacities.expand(2, -1).clone()
    opacities[1, ::2] = 0.0
    gaussians = dataclasses.replace(gaussians, colors=features, opacities=opacities)
    background = torch.rand(7, dtype=torch.float64)
    expected = GaussianRenderer()(gaussians, camera, background, ("image", "normal"))
    got = GaussianRenderer()(there(gaussians), there(camera), there(background), ("image", "normal"))
    for name in ("image", "normal"):
        assert_near(getattr(got, name).cpu(), getattr(expected, name), 1e-11)


def test_gsplats_call(device, there):
    gaussians, camera = random_scene(4, torch.float32, 150, sh_degree=2)
    values = [getattr(gaussians, name) for name in FIELDS] + [camera.extrinsics, camera.intrinsics[:, :3, :3]]
    options = {"width": 56, "height": 40, "sh_degree": 2, "render_mode": "RGB+ED", "pixel_centers": "integer"}
    renders, alphas, meta = kgs.rasterization(*(there(x) for x in values), **options)
    want, want_alphas, want_meta = kgs.rasterization(*values, **options, backend="torch")
    assert_near(renders.cpu(), want, 1e-4)
    assert_near(alphas.cpu(), want_alphas, 1e-5)
    assert torch.equal(meta["gaussian_ids"].cpu(), want_meta["gaussian_ids"])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("case", extremes.cases(), ids=lambda case: case["case"])
def test_every_bound_of_the_stiff_cases_is_met(device, case, dtype):
    row = extremes.errors(case, dtype, device)
    assert row["verdict"] == "met", row


@DTYPES
def test_what_is_not_finite_is_left_out(device, there, dtype):
    gaussians, camera = random_scene(5, dtype, 100)
    for name in FIELDS:
        spoilt = getattr(gaussians, name).clone()
        spoilt[7] = torch.nan
        moved, inputs = leaves(there(dataclasses.replace(gaussians, **{name: spoilt})))
        out = GaussianRenderer()(moved, there(camera))
        out.image.square().sum().backward()
        assert int(out.projected.num_nonfinite) == 1
        assert bool(out.image.isfinite().all())
        assert all(bool(x.grad.isfinite().all()) for x in inputs)


def test_the_same_bits_again(device, there):
    gaussians, camera = random_scene(6, torch.float32, 2000, (120, 160))

    def run():
        moved, inputs = leaves(there(gaussians))
        out = GaussianRenderer()(moved, there(camera), outputs=OUTPUTS)
        return [out.image, out.depth, out.median_depth, *torch.autograd.grad(out.image.square().sum(), inputs)]

    for first, second in zip(run(), run(), strict=True):
        assert torch.equal(first, second)


def test_reduced_precision_and_autocast_change_nothing(device, there, matmul_precision):
    gaussians, camera = random_scene(7, torch.float32, 200, sh_degree=3)
    gaussians, camera = there(gaussians), there(camera)
    before = GaussianRenderer()(gaussians, camera).image
    matmul_precision("medium")
    with torch.autocast(device.type):
        assert torch.equal(GaussianRenderer()(gaussians, camera).image, before)


def test_max_bytes_bounds_the_memory_and_keeps_the_image(device, there):
    gaussians, camera = random_scene(8, torch.float32, 4000, (256, 320), None)
    bound, inputs = 24 * 2**20, None

    def run(max_bytes):
        moved, leaf = leaves(there(gaussians))
        image = GaussianRenderer(max_bytes=max_bytes)(moved, there(camera)).image
        return image.detach().cpu(), [x.cpu() for x in torch.autograd.grad(image.square().sum(), leaf)]

    expected, wide = run(2**30)
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        held = torch.cuda.memory_allocated()
    image, inputs = run(bound)
    if device.type == "cuda":
        beside = 4000 * 4 * 120 + 256 * 320 * 4 * 40  # numbers per Gaussian, per pixel
        assert torch.cuda.max_memory_allocated() - held <= bound + beside
    assert_near(image, expected, 1e-5)
    for got, want in zip(inputs, wide, strict=True):
        assert_near(got, want, 1e-3)
