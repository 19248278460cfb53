"""Where the kernels cut an image into row slices, and the sums over the entries of each Gaussian."""

from types import SimpleNamespace

import pytest
import torch
from compositing_checks import outcome, random, sample
from targets import Target

from kgs.backends import row_slices
from kgs.backends.gpu import compositing
from kgs.backends.gpu.compositing_kernels import ROW, sum_entries
from kgs.backends.gpu.launch import blocks, launch
from kgs.geometry.covariance import moment_gradients

GIB = 2**30
KERNELS = Target("triton")


@pytest.fixture
def card(monkeypatch):
    """A card whose memory tests choose; `asked` counts how often it is asked."""
    memory = SimpleNamespace(free=0, reserved=0, allocated=0, asked=0)

    def mem_get_info(_):
        memory.asked += 1
        return memory.free, 80 * GIB

    module = SimpleNamespace(
        mem_get_info=mem_get_info,
        memory_reserved=lambda _: memory.reserved,
        memory_allocated=lambda _: memory.allocated,
    )
    monkeypatch.setattr(torch, "get_device_module", lambda _: module)
    return memory


def test_the_default_bound_is_half_of_what_a_card_has_free_and_it_is_seldom_asked(card):
    card.free, card.reserved, card.allocated = 10 * GIB, 6 * GIB, 4 * GIB
    device = torch.device("cuda", 0)
    assert row_slices.default_max_bytes(GIB, device) == GIB
    assert card.asked == 0
    assert row_slices.default_max_bytes(GIB + 1, device) == 6 * GIB
    card.free = 0
    assert row_slices.default_max_bytes(40 * GIB, device) == GIB


def test_where_a_card_does_not_say_what_is_free_the_bound_is_a_gibibyte():
    assert row_slices.default_max_bytes(40 * GIB, torch.device("cpu")) == GIB


def test_slices_follow_what_is_free_and_a_given_bound_wins(card, monkeypatch):
    monkeypatch.setattr(row_slices, "MAX_BYTES", 2**10)
    projected, certain = sample(10, (24, 9))
    numbers, real = [], compositing.GpuCompositor._fitting
    monkeypatch.setattr(
        compositing.GpuCompositor, "_fitting", lambda *a: numbers.append(len(found := real(*a))) or found
    )
    found = []
    for free, given in ((2**20, {}), (9000, {}), (2**20, {"max_bytes": 4500})):
        card.free, card.asked = free, 0
        found.append(outcome(projected, random(len(projected), 3, seed=0), certain, KERNELS, **given))
        found.append((numbers[-1], card.asked))
    (whole, one, few, two, given, again) = found
    assert one == (1, 1)
    assert two[0] > 1
    assert again == (two[0], 0)
    assert all(torch.equal(a, b) for a, b in zip(few[0] + few[1], given[0] + given[1], strict=True))
    assert all(torch.equal(a, b) for a, b in zip(whole[0], few[0], strict=True))


@pytest.mark.parametrize("add", [False, True])
def test_the_sums_of_lists_of_any_length(add):
    """Short ones, and a few with most of the entries of their block; a later slice leaves those without entries."""
    counts = torch.randint(0, 4, (70,))
    counts[[3, 20, 33, 69]] = torch.tensor([61, 700, 30, 17])
    counts[0] = 0
    n, eps2d, begins = len(counts), 0.3, torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    moments, factors, order = torch.randn(int(begins[-1]), ROW), torch.randn(n, 2, 3), torch.randperm(n)
    opacities = 0.1 + torch.rand(n)
    outputs = [torch.full(shape, 7.0 if add else torch.nan) for shape in ((n, 2), (n, 2, 3), (n,), (n, 3), (n, 2))]
    given = (order, begins, moments, factors, opacities, eps2d, n, 3, 0, *outputs)
    wanted = {"MOMENTS": True, "WITH_FEATURES": True, "ABSOLUTE": True, "ADD": add, "ADD_FEATURES": add}
    launch(sum_entries, (blocks(n, compositing.LANES),), *given, **wanted, BLOCK=compositing.LANES, warps=1)
    rows = torch.zeros(n, ROW, dtype=torch.float64)
    rows.index_add_(0, order.repeat_interleave(counts), moments.double())
    centres, shapes, opaque = moment_gradients(rows[:, :6], factors.double(), opacities.double(), eps2d)
    expected = (centres, shapes, opaque, rows[:, 6:9], rows[:, 10:])
    for got, right in zip(outputs, expected, strict=True):
        right = right + 7.0 * add
        assert (got - right).abs().max() <= 2e-6 * right.abs().max()
        assert bool((got[order[0]] == 7.0 * add).all())
