"""Compositing by Triton's kernels: what torch gives in float64."""

import dataclasses
import math
import weakref
from functools import partial

import pytest
import torch
from compositing_checks import TH, THRESHOLDS, assert_close, footprints, leaves, outcome, random, sample
from factories import batch, random_camera, random_gaussians

from kgs import RasterOptions, composite, project
from kgs.backends.gpu import compositing

SIZE = (12, 13)  # tiles that the picture ends in
run = partial(outcome, dtype=torch.float32, backend="triton")


@pytest.mark.parametrize("thresholds", THRESHOLDS)
def test_an_ordinary_scene_is_torch_in_float64(thresholds):
    options = dict(zip(("alpha_threshold", "transmittance_stop"), thresholds, strict=True))
    projected, certain = sample(20, SIZE, thresholds)
    features = random(len(projected), 3)
    assert_close(
        run(projected, features, certain, **options), outcome(projected, features, certain, **options), certain
    )


@pytest.mark.slow
@pytest.mark.parametrize("width", [0, 1, 9])
def test_any_number_of_features(width):
    projected, certain = sample(12, (5, 9))
    features = random(len(projected), width)
    assert_close(run(projected, features, certain), outcome(projected, features, certain), certain)


@pytest.mark.slow
def test_several_cameras_in_row_slices():
    gaussians = random_gaussians(10, 1, torch.float32, None, 16, (0.05, 1.0))
    cameras = batch(*(random_camera(16, 11, seed, torch.float32) for seed in range(2)))
    projected, exact = project(gaussians, cameras), {"alpha_threshold": 0.0, "transmittance_stop": 0.0}
    features = random(len(projected), 5)
    expected = outcome(projected, features, torch.ones(()), **exact)
    got = run(projected, features, torch.ones(()), **exact, max_bytes=2**13)
    assert_close(got, expected, torch.ones(()))
    with pytest.raises(ValueError, match="^max_bytes:"):
        composite(projected, features, options=RasterOptions(max_bytes=500), backend="triton")


@pytest.mark.slow
def test_a_row_slice_is_freed_before_the_next_is_made(monkeypatch):
    """In the backward pass too: `max_bytes` is for one of them."""
    projected, certain = sample(10, (24, 9))
    held, real = [], compositing.GpuCompositor._composite_rows

    def composite_rows(self, *arguments):
        assert not [1 for reference in held if reference() is not None]
        lists = real(self, *arguments)
        held[:] = [weakref.ref(x) for x in (lists.entries, lists.slots, lists.offsets, lists.starts)]
        return lists

    monkeypatch.setattr(compositing.GpuCompositor, "_composite_rows", composite_rows)
    run(projected, random(len(projected), 3), certain, max_bytes=2**13)
    assert held


def test_no_gaussians_and_no_entries():
    projected, certain = sample(0, (9, 11))
    (sums, transmittance, median), gradients = run(projected, torch.zeros(0, 3), certain)
    assert not sums.any()
    assert not median.any()
    assert (transmittance == 1).all()
    assert [len(x) for x in gradients] == [0] * 4
    unseen = footprints([0.0, 0.5], [[5.0, 4.0], [500.0, 4.0]], random(2, 2, 3), size=(9, 11), dtype=torch.float32)
    (sums, transmittance, _), gradients = run(unseen, random(2, 3), certain)
    assert not sums.any()
    assert (transmittance == 1).all()
    assert not any(x.any() for x in gradients)


@pytest.mark.parametrize("field", ["moments", "absolute", "features"])
def test_only_what_is_wanted_is_differentiated(field):
    projected, certain = sample(12, (5, 9))
    features = random(len(projected), 3)
    whole = run(projected, features, certain)[1]
    if field == "features":
        assert torch.equal(run(projected, features, certain, wanted=(False, False, False, True))[1][0], whole[3])
        return
    wanted = (True, True, True, False)
    some = run(projected, features, certain, wanted=wanted, absgrad=field == "absolute")[1]
    assert all(torch.equal(a, b) for a, b in zip(some, whole[:3], strict=True))


def test_sums_of_absolute_values_are_those_of_torch():
    projected, _ = sample(12, (5, 9))
    found = []
    for backend, dtype in (("triton", torch.float32), ("torch", torch.float64)):
        values = {k: getattr(projected, k).to(dtype) for k in ("means2d", "factors", "opacities", "depths")}
        moved, inputs = leaves(dataclasses.replace(projected, **values), projected.colors.to(dtype))
        composite(
            moved, inputs[-1], backend=backend, options=RasterOptions(absgrad=True)
        ).features.square().sum().backward()
        found.append(inputs[0].absgrad)
    assert (found[0] - found[1]).abs().max() <= 1e-5 * found[1].abs().max()


def test_the_same_bits_in_each_run_and_a_second_backward_pass():
    projected, _ = sample(12, (5, 9))
    moved, inputs = leaves(projected, random(6, len(projected)).t()[:, ::2])
    first, again = (composite(moved, inputs[-1], backend="triton") for _ in range(2))
    assert torch.equal(first.features, again.features)
    gradients = [
        torch.autograd.grad(out.features.square().sum(), inputs, retain_graph=True) for out in (first, first, again)
    ]
    assert all(torch.equal(a, b) for other in gradients[1:] for a, b in zip(gradients[0], other, strict=True))
    with pytest.raises(RuntimeError, match="expected backward without create_graph"):
        torch.autograd.grad(first.features.square().sum(), inputs, create_graph=True)


# -- stiff cases ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("opacity", [1e-30, 0.99, 1.0, 1e38, torch.inf])
@pytest.mark.parametrize("threshold", [0.0, TH])
def test_opacities_from_nothing_to_everything(opacity, threshold):
    layers = footprints([opacity, 0.5], [[5.2, 4.1], [7.0, 3.0]], 2 * random(2, 2, 3), size=(8, 11), eps2d=0.3)
    certain, features = torch.ones(()), random(2, 3)
    expected = outcome(layers, features, certain, alpha_threshold=threshold)
    got = run(layers, features, certain, alpha_threshold=threshold)
    assert_close(got, expected, certain, 2e-5, 2e-6 + 1e-6 * max(0, math.log2(min(opacity, 1e38))))


@pytest.mark.slow
@pytest.mark.parametrize("length", [30.0, 1e4])
@pytest.mark.parametrize("turn", [0.0, 0.6, math.pi / 2])
def test_needles_and_footprints_wider_than_the_picture(length, turn):
    c, s = math.cos(turn), math.sin(turn)
    needle = [[c * length, -s * 0.2, 0.0], [s * length, c * 0.2, 0.0]]
    factors = torch.tensor([needle, [[length, 0.0, 0.0], [0.0, length, 0.0]], needle])
    layers = footprints([0.6, 0.3, 0.9], [[5.3, 4.2], [3.0, 3.0], [9.0, 7.0]], factors, size=(9, 12), eps2d=0.3)
    exact = {"alpha_threshold": 0.0, "transmittance_stop": 0.0}
    features = random(3, 3)
    expected = outcome(layers, features, torch.ones(()), **exact)
    assert_close(run(layers, features, torch.ones(()), **exact), expected, torch.ones(()), 5e-5, 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("field", ["means2d", "factors", "opacities"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, 1e12])
def test_what_is_not_finite_or_overflows_is_as_in_torch(field, value):
    layers = footprints([0.7, 0.5, 0.6], 9 * torch.rand(3, 2), 2 * random(3, 2, 3), size=(9, 11), eps2d=0.3)
    changed = getattr(layers, field).clone()
    changed[1] = value if field != "factors" else value * torch.eye(2, 3)
    layers = dataclasses.replace(layers, **{field: changed})
    dtype = torch.float64 if field == "opacities" else torch.float32
    expected = outcome(layers, random(3, 3), torch.ones(()), dtype)
    got = run(layers, random(3, 3), torch.ones(()))
    assert_close((got[0], ()), (expected[0], ()), torch.ones(()), image_bound=5e-5)
    for a, b in zip(got[1], expected[1], strict=True):
        if b.isfinite().all():
            assert torch.allclose(a.double(), b.double(), atol=1e-5)


@pytest.mark.slow
def test_long_lists_end_where_the_light_does():
    layers = footprints([0.8] * 60, size=(5, 3))  # the light ends after six of them
    features = random(60, 3)
    assert_close(run(layers, features, torch.ones(())), outcome(layers, features, torch.ones(())), torch.ones(()))
