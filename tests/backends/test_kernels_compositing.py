"""Compositing of kernels: what torch gives in float64."""

import dataclasses

import pytest
import torch
from compositing_checks import (
    assert_close,
    exact,
    footprints,
    leaves,
    outcome,
    random,
    sample,
)
from refusals import refused
from targets import SELDOM_INTERPRETED, TORCH

from kgs import ArgumentError, RasterOptions, composite


@pytest.fixture
def scene(kernels):
    """Footprints, and where float32 cannot change a decision; the picture ends within tiles."""
    return sample(12, (5, 9)) if kernels.interpreted else sample(300)


def test_what_is_asked_for_beside_the_image_does_not_change_its_bits(kernels, scene):
    projected = kernels.move(scene[0])
    features = kernels.move(random(len(projected), 20))
    first = composite(projected, features[:, :3], backend=kernels.backend)
    for width in (3, 9) if kernels.interpreted else (3, 4, 6, 8, 9, 12, 20):
        for median in (False, True):
            out = composite(projected, features[:, :width], median_depth=median, backend=kernels.backend)
            assert torch.equal(out.features[:, :3], first.features)
            assert torch.equal(out.transmittance, first.transmittance)


@SELDOM_INTERPRETED
@pytest.mark.parametrize("width", [3, pytest.param(11, marks=pytest.mark.slow)])
def test_row_slices_change_nothing(kernels, width):
    few = kernels.interpreted
    projected, certain = sample(10, (24, 9)) if few else sample(400, (80, 112))
    features = random(len(projected), width)
    whole = outcome(projected, features, certain, kernels)
    for max_bytes in (5000, 2**12) if few else (2**20, 2**18):
        sliced = outcome(projected, features, certain, kernels, max_bytes=max_bytes)
        assert all(torch.equal(a, b) for a, b in zip(sliced[0], whole[0], strict=True))
        assert_close(sliced, whole, certain, 2e-6)
    with refused(ArgumentError, name="max_bytes"):
        outcome(projected, features, certain, kernels, max_bytes=500 if few else 3000)


def test_only_what_is_wanted_is_differentiated(kernels, scene):
    projected, certain = scene
    features = random(len(projected), 3)
    whole = outcome(projected, features, certain, kernels)[1]
    alone = [tuple(i == j for j in range(4)) for i in range(4)]
    for wanted in (*alone[kernels.few(0, 2) :], (True, True, True, False)):
        some = outcome(projected, features, certain, kernels, wanted=wanted)[1]
        expected = [x for x, needed in zip(whole, wanted, strict=True) if needed]
        assert all(torch.equal(a, b) for a, b in zip(some, expected, strict=True))


def test_inputs_of_any_layout_again_without_a_graph_and_in_inference_mode(kernels, scene):
    projected = kernels.move(scene[0])
    features = kernels.move(random(6, len(projected))).t()[:, ::2]
    factors = projected.factors.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    found = []
    for p, f in ((dataclasses.replace(projected, factors=factors), features), (projected, features.contiguous())):
        p, inputs = leaves(p, f)
        out = composite(p, inputs[-1], backend=kernels.backend)
        loss = out.features.mean() + out.transmittance.sum()  # whose gradients are views
        found += [torch.autograd.grad(loss, inputs, retain_graph=True) for _ in range(2)]
        with pytest.raises(RuntimeError, match="expected backward without create_graph, there is no second derivative"):
            torch.autograd.grad(loss, inputs, create_graph=True)
        with torch.inference_mode():
            assert torch.equal(composite(p, inputs[-1], backend=kernels.backend).features, out.features)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other, strict=True))


# -- sums of absolute values -----------------------------------------------------------------------------------------


def absolute(projected, target, dtype, features=3, **options):
    """The centres of one render after its backward pass, on the CPU: their gradients and sums of absolute values."""
    generator = torch.Generator().manual_seed(5)
    rows = torch.rand(len(projected), features, generator=generator, dtype=torch.float64)
    moved, (centres, *_, colors) = leaves(target.move(projected, dtype), target.move(rows, dtype))
    options = RasterOptions(**{"absgrad": True} | options)
    out = composite(moved, colors, options=options, backend=target.backend)
    image = torch.cat([out.features, out.transmittance], 1)
    (image * torch.randn(image.shape, generator=generator, dtype=torch.float64).to(image)).sum().backward()
    return centres


@pytest.mark.parametrize("options", [{}, {"max_bytes": 2**16}], ids=["whole", "slices"])
def test_sums_of_absolute_values_are_those_of_torch(kernels, scene, options):
    projected, _ = scene
    expected = absolute(projected, TORCH, torch.float64).absgrad
    found = absolute(projected, kernels, torch.float32, **options)
    assert (found.absgrad.cpu() - expected).abs().max() <= 1e-5 * expected.max()
    plain = absolute(projected, kernels, torch.float32, absgrad=False, **options)
    assert torch.equal(found.grad, plain.grad)
    assert not hasattr(plain, "absgrad")


# -- stiff cases -----------------------------------------------------------------------------------------------------


@SELDOM_INTERPRETED
@pytest.mark.parametrize("field", ["means2d", "factors", "opacities"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf, 1e9, 1e12])
def test_what_is_not_finite_or_overflows_is_as_in_torch(kernels, field, value):
    layers = footprints([0.7, 0.5, 0.6], 9 * torch.rand(3, 2), 2 * random(3, 2, 3), size=(9, 11), eps2d=0.3)
    getattr(layers, field)[1] = value if field != "factors" else value * torch.eye(2, 3)
    features = random(3, 3)
    # an exponent of a huge opacity is rounded; all else must overflow as it does in float32
    expected = exact(layers, features) if field == "opacities" else outcome(layers, features)
    got = outcome(layers, features, None, kernels)
    assert all(x.isfinite().all() for x in expected[0])
    assert_close((got[0], ()), (expected[0], ()), image_bound=5e-5)
    for a, b in zip(got[1], expected[1], strict=True):
        if b.isfinite().all():
            assert torch.allclose(a.double(), b.double(), atol=1e-5)
