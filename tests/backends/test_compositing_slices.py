"""How compositing is cut up: tiles, chunks, row slices and depth slices change nothing."""

import dataclasses

import pytest
import torch
from compositing_checks import DTYPES, STOP, TH, footprints, leaves, scene_footprints
from factories import random_camera, random_gaussians, staged
from oracles import near_threshold

from kgs import RasterOptions, backends, composite, project
from kgs.backends.torch import compositing
from kgs.backends.torch.binning import bin_to_tiles


@pytest.fixture(autouse=True)
def _torch_alone(monkeypatch):
    """The kernels have one size of tiles, and no chunks; some tests look inside the torch implementation."""
    monkeypatch.setattr(backends, "BACKENDS", {"torch": backends.BACKENDS["torch"]})


def loss_and_gradients(projected, features, weights, **options):
    projected, inputs = leaves(projected, features)
    result = composite(projected, inputs[-1], **staged(**options))
    image = torch.cat([result.features, result.transmittance], 1)
    return image.detach(), torch.autograd.grad((image * weights).sum(), inputs)


def assert_gradients_close(got, expected, bound):
    for a, b in zip(got, expected, strict=True):
        assert (a.double() - b.double()).abs().max() <= bound * b.abs().max()


@pytest.mark.parametrize("thresholds", [(0.0, 0.0), (TH, STOP)])
@pytest.mark.parametrize("dtype", DTYPES)
def test_tile_and_chunk_sizes_give_one_image_and_gradient(dtype, thresholds):
    options = dict(zip(("alpha_threshold", "transmittance_stop"), thresholds, strict=True))
    gaussians = random_gaussians(300, 5, dtype, image_size=40)
    camera = random_camera(40, 56, 5, dtype)
    certain = ~near_threshold(gaussians, camera, *thresholds)
    with torch.no_grad():
        projected = project(gaussians, camera, options=RasterOptions(alpha_threshold=thresholds[0]))
    weights = torch.randn(1, 4, 40, 56, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights = (weights * certain).to(dtype)
    first, first_gradients = loss_and_gradients(
        projected, projected.colors, weights, tile_size=4, chunk_size=1, **options
    )
    for tile_size, chunk_size in ((4, None), (5, 3), (8, 32), (64, 3)):
        image, gradients = loss_and_gradients(
            projected, projected.colors, weights, tile_size=tile_size, chunk_size=chunk_size, **options
        )
        # the exponent is a polynomial about the tile's centre: its rounding grows with the tile's area
        bound = 1e-6 * max(1.0, (tile_size / 16) ** 2) if dtype == torch.float32 else 1e-12
        assert ((image - first).abs() * certain).max() <= bound
        assert_gradients_close(gradients, first_gradients, 5 * bound)


def dense(means2d, factors, opacities, features, depths, size, eps2d):
    """Every footprint at every pixel, with the default thresholds: sums of features and transmittance, by autograd."""
    order = depths.argsort(stable=True)
    covariances = factors @ factors.mT + eps2d * torch.eye(2, dtype=factors.dtype)
    d = torch.cartesian_prod(*map(torch.arange, size)).flip(1) - means2d[:, None]
    squared = torch.einsum("npi,nij,npj->np", d, torch.linalg.inv(covariances), d)
    alphas = (opacities[:, None] * torch.exp(-0.5 * squared)).clamp(max=0.99)[order]
    alphas = torch.where(alphas >= TH, alphas, 0.0)
    transmittance = torch.cumprod(torch.cat([torch.ones_like(alphas[:1]), 1 - alphas]), 0)
    transmittance = torch.where(transmittance >= STOP, transmittance, 0.0)
    sums = torch.einsum("np,nf->fp", alphas * transmittance[:-1], features[order])
    return torch.cat([sums, transmittance[-1:]]).view(1, -1, *size)


@pytest.mark.parametrize(("chunk_size", "max_bytes"), [(1, 2**30), (3, 2**19), (None, 2**30), (None, 2**19)])
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


@pytest.fixture
def composited(monkeypatch):
    """The depth slices that are composited from here on, and whether their alphas were kept."""
    slices, real = [], compositing.DepthSlice.composite

    def noted(part, canvas, keep, keep_alphas):
        slices.append((part, keep_alphas))
        return real(part, canvas, keep, keep_alphas)

    monkeypatch.setattr(compositing.DepthSlice, "composite", noted)
    return slices


def tightest(projected, features, threshold=TH, **options):
    """The smallest `max_bytes`, up to a tenth, with which one row of tiles fits."""
    low, high = 2**14, 2**24  # enough for each scene here
    while high > 1.1 * low:
        middle = (low + high) // 2 if high < 4 * low else int((low * high) ** 0.5)
        try:
            with torch.no_grad():
                composite(projected, features, **staged(alpha_threshold=threshold, max_bytes=middle, **options))
            high = middle
        except ValueError:
            low = middle
    return high


@pytest.mark.parametrize("dtype", DTYPES)
def test_byte_budget_changes_nothing(dtype, composited):
    projected, colors, weights = scene_footprints(300, 1, dtype, image_size=40)
    free, free_gradients = loss_and_gradients(projected, colors, weights)
    assert len(composited) == 1
    budget = tightest(projected, colors)
    composited.clear()
    tight, tight_gradients = loss_and_gradients(projected, colors, weights, max_bytes=budget)
    assert len(composited) >= 2 * 3, "row slices, forward and again backward"
    assert torch.equal(tight, free)
    assert_gradients_close(tight_gradients, free_gradients, 1e-6 if dtype == torch.float32 else 1e-13)


@pytest.mark.parametrize("dtype", [pytest.param(DTYPES[0], marks=pytest.mark.slow), *DTYPES[1:]])
def test_alphas_made_again_are_those_that_were_kept(dtype, composited, monkeypatch):
    settings = dataclasses.replace(compositing.SETTINGS["cpu"], pairs=2**12)  # steps that fit whatever the budget
    monkeypatch.setitem(compositing.SETTINGS, "cpu", settings)
    projected, colors, weights = scene_footprints(300, 1, dtype, image_size=40)
    kept, kept_gradients = loss_and_gradients(projected, colors, weights)
    assert all(keep_alphas for _, keep_alphas in composited)
    budget = 2**24
    while any(keep_alphas for _, keep_alphas in composited):  # until there is room for the lists alone
        composited.clear()
        budget = int(0.8 * budget)
        lean, lean_gradients = loss_and_gradients(projected, colors, weights, max_bytes=budget)
    assert len(composited) == 1
    assert torch.equal(lean, kept)
    assert all(torch.equal(*pair) for pair in zip(lean_gradients, kept_gradients, strict=True))


@pytest.mark.parametrize(("dtype", "bound", "tight"), [(torch.float32, 1e-6, False), (torch.float64, 1e-13, True)])
@pytest.mark.parametrize(
    "thresholds", [*(pytest.param(pair, marks=pytest.mark.slow) for pair in ((0.0, 0.0), (TH, STOP))), (TH, 0.1)]
)
def test_depth_slices_change_nothing(dtype, bound, thresholds, tight, composited, monkeypatch):
    options = dict(zip(("alpha_threshold", "transmittance_stop"), thresholds, strict=True))
    projected, colors, weights = scene_footprints(300, 1, dtype, image_size=40)
    opacities = projected.opacities.sqrt()  # some tiles get dark before the last layer
    projected = dataclasses.replace(projected, opacities=opacities)
    image, gradients = loss_and_gradients(projected, colors, weights, **options)
    median = composite(projected, colors, **staged(median_depth=True, **options)).median_depth
    if tight:  # and in row slices
        options["max_bytes"] = tightest(projected, colors, thresholds[0])
    composited.clear()
    layers = 6 if thresholds[0] else 20  # without a threshold each of the 300 is in the list of each tile
    settings = dataclasses.replace(compositing.SETTINGS["cpu"], layers=layers)
    monkeypatch.setitem(compositing.SETTINGS, "cpu", settings)
    layered, layered_gradients = loss_and_gradients(projected, colors, weights, **options)
    entries = [len(part.lists.entries) for part, _ in composited]
    assert len(entries) > (6 if tight else 3)
    if thresholds[1] == 0.1:  # what lies behind the stop is not listed
        assert sum(entries) < 0.9 * (2 if tight else 1) * len(bin_to_tiles(projected).entries)
    assert (layered - image).abs().max() <= bound
    assert_gradients_close(layered_gradients, gradients, bound)
    assert torch.equal(composite(projected, colors, **staged(median_depth=True, **options)).median_depth, median)


@pytest.fixture
def as_on_a_gpu(monkeypatch):
    """Scans and sizes of steps as a GPU gets them."""
    monkeypatch.setitem(compositing.SETTINGS, "cpu", compositing.SETTINGS["cuda"])


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
