"""What must not change an image or a gradient by one bit: what is left out, autocast, threads, the memory budget."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import torch
from torch import Tensor

from kgs import Gaussians
from kgs.bench.extremes import gaussians, ordinary, render
from kgs.bench.scenes import PARAMETERS, Scene

pytestmark = pytest.mark.usefixtures("each_backend")

Result = tuple[Tensor, dict[str, Tensor]]  # an image and the gradients of all parameters


def largest_difference(results: list[Result]) -> float:
    """Between the first result and the others, which may have more Gaussians: their gradients must be 0.

    Infinity where a number is not finite.
    """
    clean, largest = results[0], 0.0
    for image, grads in results[1:]:
        pairs = [(image, clean[0])]
        for name, expected in clean[1].items():
            more = grads[name][len(expected) :]
            pairs += [(grads[name][: len(expected)], expected), (more, torch.zeros_like(more))]
        if not all(bool(x.isfinite().all()) for pair in pairs for x in pair):
            return math.inf
        largest = max([largest, *(float((x - y).abs().max()) for x, y in pairs if x.numel())])
    return largest


def with_more(scene: Scene, more: Gaussians) -> Scene:
    """One after the other, before the scene's camera."""
    cloud, view = scene
    return Gaussians(*(torch.cat([getattr(cloud, name), getattr(more, name)]) for name in PARAMETERS)), view


def spoilt(dtype: torch.dtype) -> Iterator[Result]:
    """Every parameter of a last Gaussian in turn NaN, inf and -inf, against the scene without it."""
    yield render(ordinary(100), dtype)
    for name in PARAMETERS:
        for value in (math.nan, math.inf, -math.inf):
            yield render(with_more(ordinary(100), gaussians(1, **{name: value})), dtype)


def behind(dtype: torch.dtype) -> Iterator[Result]:
    """A thousand Gaussians more, at and behind the near plane and the camera."""
    near, means = 2**-7, gaussians(1000, seed=3).means.clone()
    means[:, 2] = torch.tensor([-5.0, -1e-30, 0.0, near]).double().repeat(250)
    yield render(ordinary(100), dtype, near_plane=near)
    yield render(with_more(ordinary(100), gaussians(1000, seed=3, means=means)), dtype, near_plane=near)


def transparent(dtype: torch.dtype) -> Iterator[Result]:
    """A hundred Gaussians more, at an opacity of 0."""
    yield render(ordinary(100), dtype)
    yield render(with_more(ordinary(100), gaussians(100, seed=3, opacities=0.0)), dtype)


def under_autocast(dtype: torch.dtype) -> Iterator[Result]:
    yield render(ordinary(), dtype)
    before = torch.get_float32_matmul_precision()
    try:
        torch.set_float32_matmul_precision("medium")
        with torch.autocast("cpu", torch.bfloat16):
            yield render(ordinary(), dtype)
    finally:
        torch.set_float32_matmul_precision(before)


@contextmanager
def threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def on_threads(dtype: torch.dtype) -> Iterator[Result]:
    """Enough pairs for two threads; one and two of them, twice each."""
    for count in (1, 2, 1, 2):
        with threads(count):
            yield render(ordinary(400, (64, 64)), dtype)


def under_a_budget(dtype: torch.dtype) -> Iterator[Result]:
    """The image alone: gradients of a Gaussian are then summed in another order."""
    scene = ordinary(300, (64, 64), scales=60.0, opacities=0.02)
    for maximum in (2**30, 2**21):
        yield render(scene, dtype, max_bytes=maximum)[0], {}


CASES: dict[str, tuple[str, str, Callable[[torch.dtype], Iterator[Result]]]] = {
    "not finite, one number at a time": ("NaN times 0 is NaN", "left out before anything is computed", spoilt),
    "at and behind the near plane": ("0 and negative depths", "left out before the division", behind),
    "opacity 0": ("ln 0", "in no list, no gradient", transparent),
    "under autocast to bfloat16": (
        "8 bits of pixel coordinates",
        "no product that is rounded, both ways",
        under_autocast,
    ),
    "one and two threads, repeated": ("sums in another order", "every sum has a fixed order", on_threads),
    "under a budget of 2 MiB": ("rows are cut into slices", "a pixel does not know its row slice", under_a_budget),
}


@pytest.mark.parametrize("name", CASES)
def test_the_same_bits(name: str, each_backend: str, record_property: Callable[[str, object], None]) -> None:
    stiff, treatment, variants = CASES[name]
    single = largest_difference(list(variants(torch.float32)))
    double = "as torch" if each_backend == "numba" else largest_difference(list(variants(torch.float64)))
    row = {"case": f"{name}, {each_backend}", "stiff": stiff, "float32": single, "float64": double}
    record_property("bits", {**row, "treatment": treatment})
    assert single == 0.0
    assert double in (0.0, "as torch")


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_finite_never_counts_as_equal(value: float) -> None:
    image, gradients = render(ordinary(5), torch.float64)
    wrong = image.clone()
    wrong[0, 0, 0, 0] = value
    assert largest_difference([(wrong, gradients), (wrong, gradients)]) == math.inf


def test_a_gradient_of_what_was_added_is_seen() -> None:
    image, gradients = render(ordinary(5), torch.float64)
    more = {name: torch.cat([value, torch.ones_like(value[:1])]) for name, value in gradients.items()}
    assert largest_difference([(image, gradients), (image, more)]) == 1.0
