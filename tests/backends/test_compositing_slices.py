"""How compositing is cut up: tiles, chunks, row slices and depth slices change nothing."""

import dataclasses

import pytest
import torch
from compositing_checks import DTYPES, STOP, TH, leaves, scene_footprints
from factories import staged

from kgs import backends, composite
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


@pytest.fixture
def composited(monkeypatch):
    """The depth slices that are composited from here on."""
    slices, real = [], compositing.DepthSlice.composite

    def noted(part, *arguments):
        slices.append(part)
        return real(part, *arguments)

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
    entries = [len(part.lists.entries) for part in composited]
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
