"""Compositing of each backend: what torch gives in float64, the same bits on any number of threads."""

import dataclasses
import math
from functools import partial
from itertools import product

import pytest
import torch
from compositing_checks import TH, THRESHOLDS, assert_close, drawn, footprints, leaves, outcome, random, sample
from compositing_checks import many_bands as many_bands  # a fixture for all

from kgs import RasterOptions, composite


@pytest.fixture
def run(kernel_backend):
    """`outcome` by each backend beside torch."""
    return partial(outcome, dtype=torch.float32, backend=kernel_backend)


@pytest.mark.parametrize(
    ("width", "thresholds"),
    [*product((0, 1, 3, 4, 5, 8, 9, 11, 20), THRESHOLDS[:1]), *product((0, 3, 11), THRESHOLDS[1:])],
)
def test_any_number_of_features_is_torch_in_float64(run, width, thresholds):
    options = dict(zip(("alpha_threshold", "transmittance_stop"), thresholds, strict=True))
    projected, certain = sample(thresholds=thresholds)
    features = random(len(projected), width)
    expected = outcome(projected, features, certain, **options)
    assert_close(run(projected, features, certain, **options), expected, certain)


@pytest.mark.parametrize("size", [(8, 8), (11, 5), (1, 1), (3, 100)])
def test_image_sizes(run, size):
    projected, certain = sample(60, size=size)
    expected = outcome(projected, projected.colors, certain)
    assert_close(run(projected, projected.colors, certain), expected, certain)


def bits(run, projected, features, **options):
    images, gradients = run(projected, features, torch.ones(()), **options)
    return [*images, *gradients]


@pytest.mark.parametrize("max_bytes", [2**30, 2**18])
def test_the_same_bits_on_any_number_of_threads(run, set_threads, max_bytes):
    projected, *_ = drawn(3000, size=(80, 112))
    set_threads(1)
    first = bits(run, projected, projected.colors, max_bytes=max_bytes)
    for count in (1, 2, 3, 4):
        set_threads(count)
        got = bits(run, projected, projected.colors, max_bytes=max_bytes)
        assert all(torch.equal(a, b) for a, b in zip(got, first, strict=True))


def test_what_is_asked_for_beside_the_image_does_not_change_its_bits(kernel_backend):
    projected, *_ = drawn()
    features = random(len(projected), 20)
    first = composite(projected, features[:, :3], backend=kernel_backend)
    for width in (3, 4, 6, 8, 9, 12, 20):
        for median in (False, True):
            out = composite(projected, features[:, :width], median_depth=median, backend=kernel_backend)
            assert torch.equal(out.features[:, :3], first.features)
            assert torch.equal(out.transmittance, first.transmittance)


@pytest.mark.parametrize("width", [3, pytest.param(11, marks=pytest.mark.slow)])
def test_row_slices_change_nothing(kernel_backend, run, width):
    projected, certain = sample(800, size=(80, 112))
    features = random(len(projected), width)
    whole = run(projected, features, certain)
    for max_bytes in (2**20, 2**18):
        sliced = run(projected, features, certain, max_bytes=max_bytes)
        assert all(torch.equal(a, b) for a, b in zip(sliced[0], whole[0], strict=True))
        assert_close(sliced, whole, certain, 2e-6)
    with pytest.raises(ValueError, match="^max_bytes:"):
        composite(projected, features, options=RasterOptions(max_bytes=3000), backend=kernel_backend)


@pytest.mark.parametrize("wanted", [(0, 0, 0, 1), (0, 0, 1, 0), (1, 0, 0, 0), (0, 1, 0, 0), (1, 1, 1, 0)])
def test_only_what_is_wanted_is_differentiated(kernel_backend, wanted):
    projected, certain = sample()
    features = random(len(projected), 11)
    for backend in (kernel_backend, "torch"):
        run = partial(outcome, projected, features, certain, torch.float32, backend=backend)
        expected = [x for x, needed in zip(run()[1], wanted, strict=True) if needed]
        some = run(wanted=tuple(map(bool, wanted)))[1]
        assert all(torch.equal(a, b) for a, b in zip(some, expected, strict=True))


def test_backward_again_without_graph_and_in_inference_mode(kernel_backend):
    sampled, *_ = drawn()
    projected, inputs = leaves(sampled, random(100000, 3)[: len(sampled)])
    out = composite(projected, inputs[-1], backend=kernel_backend)
    loss = out.features.square().sum() + out.transmittance.sum()
    first = torch.autograd.grad(loss, inputs, retain_graph=True)
    assert all(
        torch.equal(a, b) for a, b in zip(torch.autograd.grad(loss, inputs, retain_graph=True), first, strict=True)
    )
    with pytest.raises(RuntimeError, match="expected backward without create_graph, there is no second derivative"):
        torch.autograd.grad(loss, inputs, create_graph=True)
    with torch.inference_mode():
        assert torch.equal(composite(projected, inputs[-1], backend=kernel_backend).features, out.features)


def test_gradients_that_are_views_and_inputs_that_are_not_contiguous(kernel_backend):
    projected, *_ = drawn()
    features = random(6, len(projected)).t()[:, ::2]
    factors = projected.factors.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    strided, inputs = leaves(dataclasses.replace(projected, factors=factors), features)
    plain, plain_inputs = leaves(projected, features.contiguous())
    for p, x in ((strided, inputs), (plain, plain_inputs)):
        out = composite(p, x[-1], backend=kernel_backend)
        (out.features.mean() + out.transmittance.sum()).backward()
    assert all(torch.equal(a.grad, b.grad) for a, b in zip(inputs, plain_inputs, strict=True))


@pytest.mark.parametrize("opacity", [1e-30, 0.5, 0.99, 1.0, 2.0, 1e6, 1e38, torch.inf])
@pytest.mark.parametrize("threshold", [0.0, TH])
def test_opacities_from_nothing_to_everything(run, opacity, threshold):
    layers = footprints([opacity, 0.5], [[5.2, 4.1], [7.0, 3.0]], 2 * random(2, 2, 3), size=(24, 40), eps2d=0.3)
    certain, features = torch.ones(()), random(2, 3)
    expected = outcome(layers, features, certain, alpha_threshold=threshold)
    got = run(layers, features, certain, alpha_threshold=threshold)
    assert_close(got, expected, certain, 2e-5, 2e-6 + 1e-6 * max(0, math.log2(min(opacity, 1e38))))


@pytest.mark.parametrize("field", ["means2d", "factors", "opacities"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf, 1e9, 1e12])
def test_what_is_not_finite_or_overflows_is_as_in_torch(run, field, value):
    layers = footprints([0.7, 0.5, 0.6], 20 * torch.rand(3, 2), 2 * random(3, 2, 3), size=(24, 40), eps2d=0.3)
    changed = getattr(layers, field).clone()
    changed[1] = value if field != "factors" else value * torch.eye(2, 3)
    layers = dataclasses.replace(layers, **{field: changed})
    features, single = random(3, 3), {"backend": "torch"}
    # an exponent of a huge opacity is rounded; all else must overflow as it does in float32
    dtype = torch.float64 if field == "opacities" else torch.float32
    expected = outcome(layers, features, torch.ones(()), dtype, **single)
    assert all(x.isfinite().all() for x in expected[0])
    got = run(layers, features, torch.ones(()))
    assert_close((got[0], ()), (expected[0], ()), torch.ones(()), image_bound=5e-5)
    for a, b in zip(got[1], expected[1], strict=True):
        if b.isfinite().all():
            assert torch.allclose(a.double(), b.double(), atol=1e-5)
