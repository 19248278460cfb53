"""Compositing against closed forms and the dense reference, and the rules that must not depend on how it is cut up."""

import dataclasses
import itertools
import math

import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from oracles import near_threshold, pinhole, random_camera, random_gaussians, theta_mass
from torch.utils._python_dispatch import TorchDispatchMode

import kgs
import kgs.reference
from kgs import GaussianRenderer, ProjectedGaussians, composite, project
from kgs.raster.tasks import Slice
from kgs.raster.tiles import bin_to_tiles

TH, STOP = 1 / 255, 1e-4
DTYPES = [torch.float32, torch.float64]
FIELDS = ("means", "quats", "scales", "opacities", "colors")


def footprints(opacities, centres=None, factors=None, depths=None, size=(3, 4), dtype=torch.float64, eps2d=0.0):
    """Hand-made projected Gaussians, front to back; without `factors` so wide that alpha is the same everywhere."""
    opacities = torch.as_tensor(opacities, dtype=dtype)
    n = opacities.shape[0]
    if factors is None:
        factors = torch.eye(2, 3, dtype=dtype).mul(1e9).expand(n, 2, 3)
    return ProjectedGaussians(
        camera_ids=torch.zeros(n, dtype=torch.int64),
        gaussian_ids=torch.arange(n),
        means2d=torch.zeros(n, 2, dtype=dtype) if centres is None else torch.as_tensor(centres, dtype=dtype),
        factors=torch.as_tensor(factors, dtype=dtype),
        depths=torch.arange(1, n + 1).to(dtype) if depths is None else torch.as_tensor(depths, dtype=dtype),
        radii=torch.ones(n, dtype=dtype),
        opacities=opacities,
        colors=torch.zeros(n, 3, dtype=dtype),
        image_size=size,
        num_cameras=1,
        num_gaussians=n,
        num_nonfinite=torch.tensor(0),
        eps2d=eps2d,
    )


def leaves(projected, features):
    """The same footprints with leaves for inputs."""
    names = ("means2d", "factors", "opacities")
    inputs = [getattr(projected, name).detach().clone().requires_grad_() for name in names]
    inputs.append(features.detach().clone().requires_grad_())
    return dataclasses.replace(projected, **dict(zip(names, inputs[:3], strict=True))), inputs


def scene_footprints(n, seed, dtype, size=(40, 56), **kwargs):
    """Footprints and colours of an ordinary scene, and two fixed weights for a loss."""
    with torch.no_grad():
        projected = project(
            random_gaussians(n, seed, dtype, **kwargs), random_camera(*size, seed, dtype), alpha_threshold=0.0
        )
    generator = torch.Generator().manual_seed(seed)
    weights = torch.randn(1, 4, *size, generator=generator, dtype=torch.float64).to(dtype)
    return projected, projected.colors, weights


def loss_and_gradients(projected, features, weights, **options):
    projected, inputs = leaves(projected, features)
    result = composite(projected, inputs[-1], **options)
    image = torch.cat([result.features, result.transmittance], 1)
    return image.detach(), torch.autograd.grad((image * weights).sum(), inputs)


def assert_gradients_close(got, expected, bound):
    for a, b in zip(got, expected, strict=True):
        assert (a.double() - b.double()).abs().max() <= bound * b.abs().max()


# --- closed forms -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("scale", [0.01, 0.2, 1.0])
def test_isotropic_gaussian_on_the_axis_is_the_closed_form(dtype, bound, scale):
    f, z, opacity = 30.0, 2.0, 0.8
    camera = pinhole(21, 27, (f, f), dtype=dtype)
    gaussians = kgs.Gaussians(
        means=torch.tensor([[0.0, 0.0, z]], dtype=dtype),
        quats=torch.tensor([[0.3, -0.5, 0.1, 0.7]], dtype=dtype),
        scales=torch.full((1, 3), scale, dtype=dtype),
        opacities=torch.tensor([opacity], dtype=dtype),
        colors=torch.tensor([[0.2, 0.5, 1.0]], dtype=dtype),
    )
    out = GaussianRenderer(alpha_threshold=0, transmittance_stop=0)(gaussians, camera, outputs=("image", "alpha"))
    y, x = torch.meshgrid(torch.arange(21.0) - 10, torch.arange(27.0) - 13, indexing="ij")
    expected = opacity * torch.exp(-(x * x + y * y).double() / (2 * ((f * scale / z) ** 2 + 0.3)))
    assert (out.alpha[0, 0] - expected).abs().max() <= bound
    colors = torch.tensor([0.2, 0.5, 1.0], dtype=torch.float64)
    assert (out.image[0] - expected * colors[:, None, None]).abs().max() <= bound


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 3e-6), (torch.float64, 1e-13)])
def test_anisotropic_footprints_are_the_explicit_quadratic_form(dtype, bound):
    generator = torch.Generator().manual_seed(0)
    factors = 3 * torch.randn(20, 2, 3, generator=generator, dtype=torch.float64)
    centres = 40 * torch.rand(20, 2, generator=generator, dtype=torch.float64)
    pixels = torch.cartesian_prod(torch.arange(37), torch.arange(43)).flip(1).double()
    for factor, centre in zip(factors.to(dtype), centres.to(dtype), strict=True):
        alone = footprints([0.7], centre[None], factor[None], size=(37, 43), dtype=dtype, eps2d=0.3)
        got = composite(alone, alone.colors, alpha_threshold=0.0, transmittance_stop=0.0).transmittance
        inverse = torch.linalg.inv(factor.double() @ factor.double().T + 0.3 * torch.eye(2, dtype=torch.float64))
        d = pixels - centre.double()
        expected = 1 - 0.7 * torch.exp(-0.5 * torch.einsum("pi,ij,pj->p", d, inverse, d))
        assert (got.reshape(-1) - expected).abs().max() <= bound


@pytest.mark.parametrize("variance", [0.3, 0.5, 2.0, 9.0])
@pytest.mark.parametrize("centre", [(20.0, 20.0), (20.5, 19.75), (19.9, 20.31)])
def test_mass_is_the_theta_function(variance, centre):
    sigma = math.sqrt(variance)
    alone = footprints([0.5], [centre], [[[sigma, 0, 0], [0, sigma, 0]]], size=(41, 41))
    mass = 1 - composite(alone, alone.colors, alpha_threshold=0.0, transmittance_stop=0.0).transmittance
    assert mass.sum().item() == pytest.approx(
        0.5 * theta_mass(variance, centre[0]) * theta_mass(variance, centre[1]), rel=1e-9
    )
    nome = math.exp(-2 * math.pi**2 * variance)
    assert mass.sum().item() == pytest.approx(math.pi * variance, rel=4 * nome * (1 + nome) + 1e-6)


@pytest.mark.parametrize("dtype", DTYPES)
def test_three_layers_by_hand(dtype):
    colors = torch.tensor([[1.0, 0.0, 0.25], [0.0, 1.0, 0.5], [0.5, 0.5, 1.0]], dtype=dtype)
    layers = footprints([0.5, 0.25, 0.9], depths=[3.0, 1.0, 2.0], dtype=dtype)  # order: 1, 2, 0
    out = composite(layers, colors)
    expected = 0.25 * colors[1] + 0.75 * 0.9 * colors[2] + 0.75 * 0.1 * 0.5 * colors[0]
    assert (out.features - expected[None, :, None, None]).abs().max() <= 1e-6
    assert (out.transmittance - 0.75 * 0.1 * 0.5).abs().max() <= 1e-7


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [1, 7, 8, 9, 40])
def test_equal_layers_are_a_geometric_series_and_weights_partition_unity(dtype, n):
    color = torch.tensor([0.3, 0.6, 0.9], dtype=dtype)
    out = composite(footprints([0.1] * n, dtype=dtype), color.expand(n, 3), transmittance_stop=0.0)
    assert (out.transmittance - 0.9**n).abs().max() <= 1e-6
    # sum of weights and transmittance is 1, to 4 eps a layer
    total = out.features + out.transmittance * color[:, None, None]
    assert (total - color[:, None, None]).abs().max() <= 4 * n * torch.finfo(dtype).eps


def test_two_coincident_halves_are_one():
    whole = composite(footprints([0.84]), torch.ones(1, 3, dtype=torch.float64))
    half = composite(footprints([0.6, 0.6]), torch.ones(2, 3, dtype=torch.float64))
    assert (whole.features - half.features).abs().max() <= 1e-12


# --- the dense reference ----------------------------------------------------------------------------------------


def against_reference(seed, dtype, thresholds, sh_degree, opacities=(0.05, 0.95)):
    """Largest image difference at certain and at doubtful pixels, share of the latter, relative gradient errors."""
    height, width, n = 40, 48, 80
    options = dict(zip(("alpha_threshold", "transmittance_stop"), thresholds, strict=True))
    gaussians = random_gaussians(n, seed, dtype, sh_degree, image_size=width, opacities=opacities)
    camera = random_camera(height, width, seed, dtype)
    doubtful = near_threshold(gaussians, camera, *thresholds)
    generator = torch.Generator().manual_seed(seed + 100)
    weights = torch.randn(3, height, width, generator=generator, dtype=torch.float64) * ~doubtful
    background = torch.rand(3, generator=generator, dtype=torch.float64).to(dtype)
    images, gradients = [], []
    for render in (
        lambda *args: GaussianRenderer(**options)(*args).image,
        lambda *a: kgs.reference.render(*a, **options),
    ):
        inputs = [getattr(gaussians, name).clone().requires_grad_() for name in FIELDS]
        inputs += [x.clone().requires_grad_() for x in (camera.extrinsics, camera.intrinsics, background)]
        posed = PinholeCamera(inputs[6], inputs[5], camera.height, camera.width)
        image = render(kgs.Gaussians(*inputs[:5]), posed, inputs[7])
        found = torch.autograd.grad((image[0].double() * weights).sum(), inputs)
        images.append(image.detach().double()[0])
        # the entries that make a camera: [R | t], and focal lengths, skew and centre
        gradients.append([*found[:5], found[5][:, :3], found[6][:, :2, :3], found[7]])
    difference = (images[0] - images[1]).abs().amax(0)
    errors = [((a.double() - b.double()).abs().max() / b.abs().max()).item() for a, b in zip(*gradients, strict=True)]
    at_doubtful = difference[doubtful].max().item() if doubtful.any() else 0.0
    return difference[~doubtful].max().item(), at_doubtful, doubtful.double().mean().item(), errors


@pytest.mark.parametrize("sh_degree", [None, 3])
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("dtype", "image_bound", "bound"), [(torch.float32, 5e-6, 1e-5), (torch.float64, 1e-10, 1e-10)]
)
def test_exact_sum_is_the_reference(seed, dtype, image_bound, bound, sh_degree):
    error, _, _, gradient_errors = against_reference(seed, dtype, (0.0, 0.0), sh_degree)
    assert error <= image_bound
    assert max(gradient_errors) <= bound


# two clamped layers leave (1 - 0.99)^2 of the light, which is the stop: opacities above 1 are often in doubt
@pytest.mark.parametrize(("opacities", "most"), [((0.05, 0.95), 1e-3), ((0.6, 1.3), 1e-2)])
@pytest.mark.parametrize(
    ("dtype", "image_bound", "bound"), [(torch.float32, 5e-6, 1e-5), (torch.float64, 1e-10, 1e-10)]
)
def test_default_thresholds_are_the_reference_away_from_decisions(dtype, image_bound, bound, opacities, most):
    share = []
    for seed in range(3):
        error, at_doubtful, doubtful, gradient_errors = against_reference(seed, dtype, (TH, STOP), 1, opacities)
        assert error <= image_bound
        assert at_doubtful <= 1e-2
        assert max(gradient_errors) <= bound
        share.append(doubtful)
    assert sum(share) / len(share) < most


# --- how it is cut up -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("thresholds", [(0.0, 0.0), (TH, STOP)])
@pytest.mark.parametrize("dtype", DTYPES)
def test_tile_and_chunk_sizes_give_one_image_and_gradient(dtype, thresholds):
    options = dict(zip(("alpha_threshold", "transmittance_stop"), thresholds, strict=True))
    gaussians = random_gaussians(300, 5, dtype, image_size=40)
    camera = random_camera(40, 56, 5, dtype)
    certain = ~near_threshold(gaussians, camera, *thresholds)
    with torch.no_grad():
        projected = project(gaussians, camera, alpha_threshold=thresholds[0])
    weights = torch.randn(1, 4, 40, 56, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights = (weights * certain).to(dtype)
    first, first_gradients = loss_and_gradients(
        projected, projected.colors, weights, tile_size=4, chunk_size=1, **options
    )
    for tile_size, chunk_size in [
        (4, None),
        (5, 3),
        (8, 1),
        (8, 3),
        (8, 8),
        (8, 32),
        (16, 8),
        (32, 32),
        (64, 3),
        (64, None),
    ]:
        image, gradients = loss_and_gradients(
            projected, projected.colors, weights, tile_size=tile_size, chunk_size=chunk_size, **options
        )
        # the exponent is a polynomial about the tile's centre: its rounding grows with the tile's area
        bound = 1e-6 * max(1.0, (tile_size / 16) ** 2) if dtype == torch.float32 else 1e-12
        assert ((image - first).abs() * certain).max() <= bound
        assert_gradients_close(gradients, first_gradients, 5 * bound)


def dense(means2d, factors, opacities, features, depths, size, eps2d):
    """Every footprint at every pixel, with the default thresholds: sums of features and light, by autograd."""
    order = depths.argsort(stable=True)
    covariances = factors @ factors.mT + eps2d * torch.eye(2, dtype=factors.dtype)
    d = torch.cartesian_prod(*map(torch.arange, size)).flip(1) - means2d[:, None]
    squared = torch.einsum("npi,nij,npj->np", d, torch.linalg.inv(covariances), d)
    alphas = (opacities[:, None] * torch.exp(-0.5 * squared)).clamp(max=0.99)[order]
    alphas = torch.where(alphas >= TH, alphas, 0.0)
    light = torch.cumprod(torch.cat([torch.ones_like(alphas[:1]), 1 - alphas]), 0)
    light = torch.where(light >= STOP, light, 0.0)
    sums = torch.einsum("np,nf->fp", alphas * light[:-1], features[order])
    return torch.cat([sums, light[-1:]]).view(1, -1, *size)


@pytest.mark.parametrize("chunk_size", [1, 3, None])
@pytest.mark.parametrize("max_bytes", [2**30, 2**19])
def test_tiles_that_end_at_different_depths(chunk_size, max_bytes):
    # veils over all, and an opaque curtain for each column of tiles at another depth: tiles end one after the other
    size, columns, veils = (20, 72), 9, 120
    generator = torch.Generator().manual_seed(0)
    walls = [(8 * c + 3.5, 10.0, 12.0 * (c * 4 % columns) + 0.5) for c in range(columns - 1)] * 8
    centres = [(72 * x, 20 * y) for x, y in torch.rand(veils, 2, generator=generator).tolist()]
    centres += [(x, y) for x, y, _ in walls]
    curtain = torch.tensor([[5.0, 0, 0], [0, 60, 0]])
    factors = torch.cat([25 * torch.eye(2, 3).expand(veils, 2, 3), curtain.expand(len(walls), 2, 3)])
    factors = factors + torch.randn(factors.shape, generator=generator)
    opacities = torch.cat([0.01 + 0.02 * torch.rand(veils, generator=generator), torch.full((len(walls),), 0.98)])
    depths = torch.cat([torch.arange(veils), torch.tensor([z for *_, z in walls])])
    projected = footprints(opacities, centres, factors, depths, size, eps2d=0.3)
    colors = torch.rand(len(depths), 3, generator=generator, dtype=torch.float64)
    weights = torch.randn(1, 4, *size, generator=generator, dtype=torch.float64)
    image, gradients = loss_and_gradients(projected, colors, weights, chunk_size=chunk_size, max_bytes=max_bytes)
    _, inputs = leaves(projected, colors)
    expected = dense(*inputs, projected.depths, size, 0.3)
    assert (expected[:, 3] == 0).double().mean() > 0.3
    assert (expected[:, 3] > 0.05).double().mean() > 0.05
    assert (image - expected).abs().max() <= 1e-12
    assert_gradients_close(gradients, torch.autograd.grad((expected * weights).sum(), inputs), 1e-10)


def tightest(projected, features, threshold=TH, **options):
    """The smallest `max_bytes`, up to a tenth, with which one row of tiles fits."""
    low, high = 1, 2**30
    while high > 1.1 * low:
        middle = (low + high) // 2 if high < 4 * low else int((low * high) ** 0.5)
        try:
            with torch.no_grad():
                composite(projected, features, alpha_threshold=threshold, max_bytes=middle, **options)
            high = middle
        except ValueError:
            low = middle
    return high


@pytest.fixture
def made(monkeypatch):
    """The slices that are made from here on."""
    found, init = [], Slice.__init__

    def noted(part, *arguments):
        init(part, *arguments)
        found.append(part)

    monkeypatch.setattr(Slice, "__init__", noted)
    return found


@pytest.mark.parametrize("dtype", DTYPES)
def test_byte_budget_changes_nothing(dtype, made):
    projected, colors, weights = scene_footprints(300, 1, dtype, image_size=40)
    free, free_gradients = loss_and_gradients(projected, colors, weights)
    assert len(made) == 1
    budget = tightest(projected, colors)
    made.clear()
    tight, tight_gradients = loss_and_gradients(projected, colors, weights, max_bytes=budget)
    assert len(made) >= 2 * 3, "row slices, forward and again backward"
    assert torch.equal(tight, free)
    assert_gradients_close(tight_gradients, free_gradients, 1e-6 if dtype == torch.float32 else 1e-13)


@pytest.mark.parametrize("dtype", DTYPES)
def test_alphas_made_again_are_those_that_were_kept(dtype, made, monkeypatch):
    monkeypatch.setattr("kgs.raster.torch_passes.buffer_bytes", lambda *_: 2**20)  # so that groups stay the same
    projected, colors, weights = scene_footprints(300, 1, dtype, image_size=40)

    def steps():
        return [step for part in made for group in part.groups for step in group.steps]

    kept, kept_gradients = loss_and_gradients(projected, colors, weights)
    assert len(steps()) > 0
    assert all(step.alpha is not None for step in steps())
    budget = 2**30
    while any(step.alpha is not None for step in steps()):  # until there is room for the lists alone
        made.clear()
        budget = int(0.9 * budget)
        lean, lean_gradients = loss_and_gradients(projected, colors, weights, max_bytes=budget)
    assert len(made) == 1
    assert torch.equal(lean, kept)
    assert all(torch.equal(*pair) for pair in zip(lean_gradients, kept_gradients, strict=True))


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("thresholds", [(0.0, 0.0), (TH, STOP), (TH, 0.1)])
@pytest.mark.parametrize("tight", [False, True])
def test_depth_slices_change_nothing(dtype, bound, thresholds, tight, made, monkeypatch):
    options = dict(zip(("alpha_threshold", "transmittance_stop"), thresholds, strict=True))
    projected, colors, weights = scene_footprints(300, 1, dtype, image_size=40)
    opacities = projected.opacities.sqrt()  # some tiles get dark before the last layer
    projected = dataclasses.replace(projected, opacities=opacities)
    image, gradients = loss_and_gradients(projected, colors, weights, **options)
    median = composite(projected, colors, median_depth=True, **options).median_depth
    if tight:  # and in row slices
        options["max_bytes"] = tightest(projected, colors, thresholds[0])
    made.clear()
    monkeypatch.setattr("kgs.raster.torch_passes._LAYERS", 6)
    layered, layered_gradients = loss_and_gradients(projected, colors, weights, **options)
    entries = [len(part.lists.entries) for part in made]
    assert len(entries) > (6 if tight else 3)
    if thresholds[1] == 0.1:  # what lies behind the end of the light is not listed
        assert sum(entries) < 0.9 * (2 if tight else 1) * len(bin_to_tiles(projected).entries)
    assert (layered - image).abs().max() <= bound
    assert_gradients_close(layered_gradients, gradients, bound)
    assert torch.equal(composite(projected, colors, median_depth=True, **options).median_depth, median)


@pytest.fixture
def as_on_a_gpu(monkeypatch):
    """Scans and sizes of steps as a GPU gets them."""
    made = Slice.__init__

    def init(part, *arguments):
        made(part, *arguments)
        part.by_layer = False

    monkeypatch.setattr(Slice, "__init__", init)
    monkeypatch.setattr("kgs.raster.tasks._STEP_PAIRS", {"cpu": 2**24})
    monkeypatch.setattr("kgs.raster.tasks._PAIRS_TO_SHARE", 2**60)
    monkeypatch.setattr("kgs.raster.torch_passes.choose_chunk_size", lambda _: 32)


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 2e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("thresholds", [(0.0, 0.0), (TH, STOP), (TH, 0.1)])
def test_the_scans_of_a_gpu_give_the_same(dtype, bound, thresholds, request):
    options = dict(zip(("alpha_threshold", "transmittance_stop"), thresholds, strict=True))
    projected, colors, weights = scene_footprints(300, 1, dtype, image_size=40)
    image, gradients = loss_and_gradients(projected, colors, weights, **options)
    request.getfixturevalue("as_on_a_gpu")
    other, other_gradients = loss_and_gradients(projected, colors, weights, **options)
    assert (other - image).abs().max() <= bound
    assert_gradients_close(other_gradients, gradients, bound)


class _Launches(TorchDispatchMode):
    """Counts the operators that would be kernels on a GPU."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        self.count += not func.is_view
        return result


def test_launches_do_not_grow_with_gaussians_or_pixels(as_on_a_gpu, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)  # the counter sees this thread alone

    def launches(n, size):
        projected, colors, weights = scene_footprints(n, 1, torch.float32, size, image_size=80)
        with _Launches() as mode:
            loss_and_gradients(projected, colors, weights)
        return mode.count

    few = launches(100, (40, 56))
    assert few <= 500
    assert launches(100, (160, 224)) <= few
    assert launches(800, (160, 224)) <= few + 300  # lists longer than 32 take a second and a third step


@pytest.mark.parametrize("size", [(8, 8), (8, 24), (24, 8), (11, 5)])
def test_incoming_gradients_are_left_alone(size):
    projected, inputs = leaves(*scene_footprints(40, 1, torch.float64, size=size)[:2])
    out = composite(projected, inputs[-1])
    grads = [torch.ones_like(out.features), torch.full_like(out.transmittance, 2.0)]
    torch.autograd.backward([out.features, out.transmittance], grads, retain_graph=True)
    first = [x.grad.clone() for x in inputs]
    torch.autograd.backward([out.features, out.transmittance], grads)
    assert (grads[0] == 1).all()
    assert (grads[1] == 2).all()
    assert all(torch.equal(x.grad, 2 * g) for x, g in zip(inputs, first, strict=True))


def test_too_small_a_budget_is_an_error_with_the_numbers():
    projected, colors, _ = scene_footprints(50, 1, torch.float32)
    with pytest.raises(ValueError, match=r"max_bytes.*\d+ bytes"):
        composite(projected, colors, max_bytes=160)


@pytest.mark.slow
def test_many_screen_filling_gaussians_under_a_budget():
    n, size = 2000, (256, 256)
    generator = torch.Generator().manual_seed(0)
    centres = 256 * torch.rand(n, 2, generator=generator)
    factors = 150 * torch.eye(2, 3) + 10 * torch.randn(n, 2, 3, generator=generator)
    projected = footprints(torch.full((n,), 0.01), centres, factors, size=size, dtype=torch.float32, eps2d=0.3)
    colors = torch.rand(n, 3, generator=generator)
    weights = torch.randn(1, 4, *size, generator=generator)
    free, free_gradients = loss_and_gradients(projected, colors, weights)
    tight, tight_gradients = loss_and_gradients(projected, colors, weights, max_bytes=64 * 2**20)
    assert torch.equal(tight, free)
    assert_gradients_close(tight_gradients, free_gradients, 1e-5)


def test_cameras_in_one_call_do_not_mix():
    projected, colors, weights = scene_footprints(60, 2, torch.float64)
    n = len(projected)
    names = ("gaussian_ids", "means2d", "factors", "depths", "radii", "opacities", "colors")
    twice = {name: torch.cat([getattr(projected, name)] * 2) for name in names}
    both = dataclasses.replace(projected, **twice, camera_ids=torch.arange(2).repeat_interleave(n), num_cameras=2)
    single, single_gradients = loss_and_gradients(projected, colors, weights)
    double, gradients = loss_and_gradients(both, torch.cat([colors, colors]), torch.cat([weights, 3 * weights]))
    assert torch.equal(double, torch.cat([single, single]))
    for got, expected in zip(gradients, single_gradients, strict=True):
        assert_gradients_close([got[:n], got[n:]], [expected, 3 * expected], 1e-13)


# --- thresholds -------------------------------------------------------------------------------------------------


def test_stop_is_inclusive():
    # T behind two layers of 0.99 is 9.99998e-5 in float32 and 1.0000000000000002e-4 in float64: both must count them
    white = {}
    for dtype in DTYPES:
        out = composite(footprints([0.99, 0.99], dtype=dtype), torch.eye(2, 3, dtype=dtype))
        assert (out.features[0, :2, 0, 0].double() - torch.tensor([0.99, 0.0099])).abs().max() <= 1e-6
        white[dtype] = (out.features[:, :2].sum(1) + out.transmittance[:, 0]).double()
    assert (white[torch.float32] - white[torch.float64]).abs().max() <= STOP + 1e-6


@pytest.mark.parametrize("dtype", DTYPES)
def test_nothing_counts_behind_the_stop(dtype):
    opacities = [0.9, 0.9, 0.9, 0.9, 0.9]  # T: 1, .1, .01, .001, 1e-4 (just above or below), ...
    out = composite(footprints(opacities, dtype=dtype), torch.eye(5, dtype=dtype), transmittance_stop=0.005)
    expected = torch.tensor([0.9, 0.09, 0.009, 0.0, 0.0], dtype=dtype)
    assert (out.features[0, :, 0, 0] - expected).abs().max() <= 1e-7
    assert not out.transmittance.any()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("stop", [0.02, 0.05, 0.5])
def test_light_of_exactly_the_stop_is_the_border(stop, dtype):
    for left, counts in ((stop * (1 - 1e-4), False), (stop * (1 + 1e-4), True)):
        out = composite(footprints([1 - left, 0.5], dtype=dtype), torch.eye(2, dtype=dtype), transmittance_stop=stop)
        assert (out.features[0, 1] - 0.5 * left * counts).abs().max() <= 1e-6
        assert not out.transmittance.any()


@pytest.mark.parametrize("stop", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("seed", [0, 1])
def test_error_of_the_stop_is_at_most_the_stop(seed, stop):
    projected, colors, _ = scene_footprints(300, seed, torch.float64, image_size=20, opacities=(0.3, 0.95))
    exact = composite(projected, colors, alpha_threshold=0.0, transmittance_stop=0.0)
    got = composite(projected, colors, alpha_threshold=0.0, transmittance_stop=stop)
    scale = colors.max()
    assert (got.transmittance == 0).double().mean() > 0.1  # otherwise there is nothing to test
    assert (got.features - exact.features).abs().max() <= stop * scale
    assert (got.transmittance - exact.transmittance).abs().max() <= stop


@pytest.mark.parametrize("threshold", [1 / 64, 1 / 255, 1e-4])
def test_error_of_the_threshold_is_at_most_layers_times_it(threshold):
    gaussians, camera = random_gaussians(200, 3, image_size=40, sh_degree=None), random_camera(40, 40, 3)
    options = {"alpha_threshold": threshold, "transmittance_stop": STOP}
    exact = GaussianRenderer(alpha_threshold=0, transmittance_stop=0)(gaussians, camera, torch.ones(3).double()).image
    got = GaussianRenderer(**options)(gaussians, camera, torch.ones(3).double()).image
    alphas = kgs.reference.layers(gaussians, camera, 0.0, 0.0).responses
    skipped = (alphas * (alphas < threshold)).sum(0)
    error = (got - exact).abs().amax(1)[0]
    assert (error <= skipped + STOP + 1e-12).all()
    assert (skipped <= 200 * threshold).all()
    assert error.max() > threshold / 20  # the threshold acts


def test_light_grows_with_the_threshold_and_falls_with_the_stop():
    projected, colors, _ = scene_footprints(200, 4, torch.float64, image_size=30)

    def light(threshold, stop):
        return composite(projected, colors, alpha_threshold=threshold, transmittance_stop=stop).transmittance

    by_threshold = [light(threshold, 0.0) for threshold in (0.0, 1e-4, 1 / 1024, 1 / 255, 1 / 64, 0.3)]
    by_stop = [light(0.0, stop) for stop in (0.0, 1e-6, 1e-4, 1e-2, 0.5)]
    for less, more in itertools.pairwise(by_threshold):
        assert (more - less).min() >= -1e-14
    for more, less in itertools.pairwise(by_stop):
        assert (more - less).min() >= -1e-14
    assert (by_threshold[-1] - by_threshold[0]).max() > 0.01
    assert (by_stop[0] - by_stop[-1]).max() > 0.01


def test_a_layer_counts_from_the_threshold_on():
    for opacity, drawn in ((TH * (1 - 1e-5), False), (TH * (1 + 1e-5), True)):
        layer = footprints([opacity], dtype=torch.float32)
        assert bool((composite(layer, layer.colors).transmittance < 1).all()) is drawn


# --- the clamp of alpha -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("opacity", [0.98, 0.995, 1.3])
def test_clamp_of_alpha_and_its_exact_gradient(opacity, dtype):
    alpha, slope = min(opacity, 0.99), float(opacity < 0.99)
    projected, inputs = leaves(footprints([opacity, 0.5], dtype=dtype), torch.tensor([[1.0], [3.0]], dtype=dtype))
    out = composite(projected, inputs[-1])
    assert (out.features - (alpha + 3 * 0.5 * (1 - alpha))).abs().max() <= 1e-6
    (out.features.sum() + 7 * out.transmittance.sum()).backward()
    pixels = 12
    # d/da of  a + 3 (1 - a) / 2 + 7 (1 - a) / 2,  and of the layer behind
    expected = [slope * pixels * (1 - 1.5 - 3.5), pixels * (1 - alpha) * (3 - 7)]
    assert (inputs[2].grad - torch.tensor(expected, dtype=dtype)).abs().max() <= 1e-4
    assert (inputs[3].grad[:, 0] - torch.tensor([alpha, 0.5 * (1 - alpha)]) * pixels).abs().max() <= 1e-5


@pytest.mark.parametrize("opacity", [0.98, 0.995, 1.3])
def test_clamp_holds_pixel_by_pixel_in_the_gradient(opacity):
    generator = torch.Generator().manual_seed(3)
    start = footprints(
        [opacity, 0.6], [[5.2, 4.1], [7.0, 3.0]], 4 * torch.randn(2, 2, 3, generator=generator), size=(9, 12), eps2d=0.3
    )
    colors = torch.rand(2, 3, generator=generator, dtype=torch.float64)

    def image(means2d, factors, opacities, features):
        made = dataclasses.replace(start, means2d=means2d, factors=factors, opacities=opacities)
        out = composite(made, features, alpha_threshold=0.0, transmittance_stop=0.0)
        return torch.cat([out.features, out.transmittance], 1)

    weights = torch.randn(1, 4, 9, 12, generator=generator, dtype=torch.float64)
    _, inputs = leaves(start, colors)
    assert torch.autograd.gradcheck(lambda *x: (image(*x) * weights).sum((2, 3)), inputs, eps=1e-6, atol=1e-6)


# --- many layers ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha", [1 / 250, 0.05])
def test_twenty_thousand_layers(alpha):
    n = 20000
    generator = torch.Generator().manual_seed(0)
    opacities = alpha * (1 + torch.rand(n, generator=generator))
    colors = torch.rand(n, 3, generator=generator)
    projected, inputs = leaves(footprints(opacities, size=(2, 2), dtype=torch.float32), colors)
    out = composite(projected, inputs[-1], tile_size=2, transmittance_stop=0.0)
    got = torch.autograd.grad(out.features.mean((2, 3)).sum() + out.transmittance.mean(), inputs)

    a, c = (x.double().requires_grad_() for x in (opacities, colors))
    light = torch.cumprod(torch.cat([torch.ones(1), 1 - a]), 0)
    expected = ((a * light[:-1])[:, None] * c).sum(0)
    d_opacities, d_colors = torch.autograd.grad(expected.sum() + light[-1], (a, c))
    assert ((out.features[0, :, 0, 0] - expected) / expected).abs().max() <= 1e-5
    assert (out.transmittance - light[-1].detach()).abs().max() <= 1e-6
    assert all(gradient.isfinite().all() for gradient in got)
    seen = light[:-1] > 1e-6
    assert ((got[3] - d_colors) / d_colors)[seen].abs().max() <= 1e-5
    assert (got[2] - d_opacities).abs().max() <= 1e-5 * d_opacities.abs().max()
    dark = light[:-1] < 1e-46
    assert not got[2][dark].any()
    assert not got[3][dark].any()


@pytest.mark.parametrize("n", [1000, 20000])
def test_transmittance_of_many_layers_is_accurate(n):
    out = composite(footprints([1 / 250] * n, size=(2, 2), dtype=torch.float32), torch.ones(n, 1), tile_size=2)
    exact = (1 - 1 / 250) ** n
    if exact > 1e-4:
        assert ((out.transmittance - exact) / exact).abs().max() <= 1e-5
    else:
        assert not out.transmittance.any()
    assert (out.features - (1 - exact)).abs().max() <= STOP + 1e-5


# --- depth and features -----------------------------------------------------------------------------------------


def test_median_depth_is_where_less_than_half_the_light_remains():
    def median(opacities, depths):
        layers = footprints(opacities, depths=depths)
        return composite(layers, layers.colors, median_depth=True, chunk_size=2).median_depth

    assert (median([0.3, 0.3, 0.3, 0.9], [1.0, 2.0, 3.0, 4.0]) == 2).all()  # T: .7, .49
    assert (median([0.25, 0.25, 0.25, 0.9], [1.0, 2.0, 3.0, 4.0]) == 3).all()  # T: .75, .5625, .42
    assert (median([0.9, 0.3, 0.3], [5.0, 2.0, 3.0]) == 3).all()  # sorted by depth
    assert (median([0.1, 0.1], [1.0, 2.0]) == 0).all()
    assert (median([0.5], [1.0]) == 0).all()  # exactly half is not less than half
    assert (median([], []) == 0).all()


def test_median_depth_is_only_made_when_asked_for_and_has_no_gradient():
    projected, inputs = leaves(footprints([0.6, 0.6]), torch.ones(2, 3).double())
    assert composite(projected, inputs[-1]).median_depth is None
    found = composite(projected, inputs[-1], median_depth=True).median_depth
    assert found.shape == (1, 1, 3, 4)
    assert not found.requires_grad


@pytest.mark.parametrize("dtype", DTYPES)
def test_features_of_any_width(dtype):
    projected, _, _ = scene_footprints(40, 6, dtype)
    features = torch.randn(len(projected), 7, generator=torch.Generator().manual_seed(0), dtype=dtype)
    wide, wide_inputs = leaves(projected, features)
    full = composite(wide, wide_inputs[-1])
    full.features.sum().backward()
    bound = 1e-6 if dtype == torch.float32 else 1e-14
    for width in (0, 1, 3, 7):
        narrow, inputs = leaves(projected, features[:, :width])
        out = composite(narrow, inputs[-1])
        assert out.features.shape == (1, width, 40, 56)
        assert torch.equal(out.transmittance, full.transmittance)
        assert ((out.features - full.features[:, :width]).abs() <= bound).all()
        (out.features.sum() + out.transmittance.sum()).backward()
        assert inputs[-1].grad.shape == (len(projected), width)
        assert ((inputs[-1].grad - wide_inputs[-1].grad[:, :width]).abs() <= bound * wide_inputs[-1].grad.max()).all()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("tile_size", 0),
        ("tile_size", 8.0),
        ("max_bytes", 0),
        ("backend", "cuda"),
        ("chunk_size", 0),
        ("alpha_threshold", -0.1),
        ("alpha_threshold", 1.0),
        ("alpha_threshold", math.nan),
        ("transmittance_stop", -1e-9),
        ("transmittance_stop", 1.0),
    ],
)
def test_options_out_of_range_are_named(option, value):
    layers = footprints([0.5])
    with pytest.raises(ValueError, match=option):
        composite(layers, layers.colors, **{option: value})
