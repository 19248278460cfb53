"""What must not change a bit: what is left out, autocast, threads, the memory budget, what a program sets for torch."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from factories import FIELDS, OUTPUTS, random_camera, random_gaussians
from targets import CPU, move
from torch import Tensor

from kgs import GaussianRenderer, Gaussians, pinhole_cameras
from kgs.bench.extremes import gaussians, ordinary
from kgs.bench.scenes import PARAMETERS, Scene

Result = tuple[Tensor, dict[str, Tensor]]  # images and the gradients of all parameters
DTYPES = [torch.float32, torch.float64]
MATRICES = ("extrinsics", "intrinsics")


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


def ordinary_views(n: int = 2500, size: tuple[int, int] = (80, 112)) -> Scene:
    """By default enough for several pieces of work."""
    return random_gaussians(n, 0, sh_degree=1, image_size=120), random_camera(*size, 0)


def everything(
    scene: Scene, device: torch.device, dtype: torch.dtype, wanted: tuple[str, ...] = FIELDS, **options: float
) -> Result:
    """All outputs of a render, and the gradients of Gaussians, or of these and the camera."""
    made, camera = scene
    inputs = {name: move(x, device, dtype).clone() for name, x in vars(made).items()}
    inputs |= {name: move(getattr(camera, name), device, dtype).clone() for name in MATRICES}
    for name in wanted:
        inputs[name].requires_grad_()
    posed = pinhole_cameras(inputs["extrinsics"], inputs["intrinsics"], int(camera.width), int(camera.height))
    out = GaussianRenderer(**options)(Gaussians(*(inputs[name] for name in FIELDS)), posed, outputs=OUTPUTS)
    loss = out.image.square().sum() + out.depth.mean()
    slopes = torch.autograd.grad(loss, [inputs[name] for name in wanted])
    images = torch.cat([getattr(out, name).detach() for name in OUTPUTS], 1)
    return images, dict(zip(wanted, slopes, strict=True))


def with_more(scene: Scene, more: Gaussians, first: bool = False) -> Scene:
    """One after the other, or the other way round, before the scene's camera."""
    cloud, view = scene
    parts = (more, cloud) if first else (cloud, more)
    return Gaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in PARAMETERS)), view


def spoilt(device: torch.device, dtype: torch.dtype) -> Iterator[Result]:
    """One number of each parameter of a last Gaussian NaN, inf and -inf, against the scene without it."""
    yield everything(ordinary(100), device, dtype)
    for name in PARAMETERS:
        for value in (math.nan, math.inf, -math.inf):
            last = gaussians(1, seed=3)
            getattr(last, name).view(-1)[-1] = value
            yield everything(with_more(ordinary(100), last), device, dtype)


def behind(device: torch.device, dtype: torch.dtype) -> Iterator[Result]:
    """A thousand Gaussians more, at and behind the near plane and the camera."""
    near, means = 2**-7, gaussians(1000, seed=3).means.clone()
    means[:, 2] = torch.tensor([-5.0, -1e-30, 0.0, near]).double().repeat(250)
    yield everything(ordinary(100), device, dtype, near_plane=near)
    yield everything(with_more(ordinary(100), gaussians(1000, seed=3, means=means)), device, dtype, near_plane=near)


def transparent(device: torch.device, dtype: torch.dtype) -> Iterator[Result]:
    """A hundred Gaussians more, at an opacity of 0."""
    yield everything(ordinary(100), device, dtype)
    yield everything(with_more(ordinary(100), gaussians(100, seed=3, opacities=0.0)), device, dtype)


def under_autocast(device: torch.device, dtype: torch.dtype) -> Iterator[Result]:
    yield everything(ordinary(), device, dtype)
    before = torch.get_float32_matmul_precision()
    try:
        torch.set_float32_matmul_precision("medium")
        with torch.autocast(device.type, torch.bfloat16):
            yield everything(ordinary(), device, dtype)
    finally:
        torch.set_float32_matmul_precision(before)


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def on_threads(device: torch.device, dtype: torch.dtype) -> Iterator[Result]:
    """Enough pairs for several threads; one to three of them, and one again."""
    scene = ordinary_views(2500 if dtype == torch.float32 else 500)  # torch, alone in float64, shares out less as well
    for count in (1, 2, 3, 1):
        with threads(count):
            yield everything(scene, device, dtype, (*FIELDS, *MATRICES))


def under_a_budget(device: torch.device, dtype: torch.dtype) -> Iterator[Result]:
    """The image alone: gradients of a Gaussian are then summed in another order."""
    scene = ordinary(300, (64, 64), scales=60.0, opacities=0.02)
    for maximum in (2**30, 2**21):
        yield everything(scene, device, dtype, max_bytes=maximum)[0], {}


CASES: dict[str, tuple[str, str, Callable[[torch.device, torch.dtype], Iterator[Result]]]] = {
    "not finite, one number at a time": ("NaN times 0 is NaN", "left out before anything is computed", spoilt),
    "at and behind the near plane": ("0 and negative depths", "left out before the division", behind),
    "opacity 0": ("ln 0", "in no list, no gradient", transparent),
    "under autocast to bfloat16": (
        "8 bits of pixel coordinates",
        "no product that is rounded, both ways",
        under_autocast,
    ),
    "one to three threads, repeated": ("sums in another order", "every sum has a fixed order", on_threads),
    "under a budget of 2 MiB": ("rows are cut into slices", "a pixel does not know its row slice", under_a_budget),
}


@pytest.mark.parametrize("name", CASES)
def test_the_same_bits(
    name: str,
    each_device: torch.device,
    request: pytest.FixtureRequest,
    record_property: Callable[[str, object], None],
) -> None:
    stiff, treatment, variants = CASES[name]
    where = request.node.callspec.params["each_device"]
    single = largest_difference(list(variants(each_device, torch.float32)))
    double = "as torch" if where == "numba" else largest_difference(list(variants(each_device, torch.float64)))
    row = {"case": f"{name}, {where}", "stiff": stiff, "float32": single, "float64": double}
    record_property("bits", {**row, "treatment": treatment})
    assert single == 0.0
    assert double in (0.0, "as torch")


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "size", "max_bytes"), [(100, (24, 32), 2**30), (300, (80, 112), 2**20)])
def test_one_and_two_threads_are_equal_in_one_piece_and_in_row_slices(
    n: int, size: tuple[int, int], max_bytes: int, dtype: torch.dtype, each_device: torch.device
) -> None:
    found = []
    for count in (1, 2):
        with threads(count):
            scene, wanted = ordinary_views(n, size), (*FIELDS, *MATRICES)
            found.append(everything(scene, each_device, dtype, wanted, max_bytes=max_bytes))
    assert largest_difference(found) == 0.0


@pytest.mark.parametrize("dtype", DTYPES)
def test_what_cannot_be_seen_changes_no_bit_before_or_after_the_others(
    dtype: torch.dtype, each_device: torch.device
) -> None:
    scene, more = ordinary(100), gaussians(100, seed=3)
    image, plain = everything(scene, each_device, dtype)
    hidden = [
        dataclasses.replace(more, opacities=torch.zeros_like(more.opacities)),
        dataclasses.replace(more, means=-more.means),
        dataclasses.replace(more, opacities=torch.full_like(more.opacities, 0.99 / 255)),
        dataclasses.replace(more, means=more.means + torch.tensor([1e3, 0.0, 0.0], dtype=torch.float64)),
    ]
    for extra in hidden:
        for first in (False, True):
            other, grads = everything(with_more(scene, extra, first), each_device, dtype)
            if first:
                grads |= {name: grads[name].roll(-len(more), 0) for name in FIELDS}
            assert largest_difference([(image, plain), (other, grads)]) == 0.0


def test_rendering_leaves_threads_and_random_numbers_alone(each_device: torch.device) -> None:
    state = torch.get_rng_state()
    for count in (2, 3):
        with threads(count):
            everything(ordinary_views(300), each_device, torch.float32)
            assert torch.get_num_threads() == count
            seen = []
            born_later = threading.Thread(target=lambda seen=seen: seen.append(torch.get_num_threads()))
            born_later.start()
            born_later.join()
            assert seen == [count]
    assert torch.equal(torch.get_rng_state(), state)


def test_renders_at_the_same_time_are_equal_to_one(each_device: torch.device) -> None:
    def run(_: object = None) -> Result:
        return everything(ordinary_views(500), each_device, torch.float32)

    with threads(2), ThreadPoolExecutor(3) as pool:
        expected, found = run(), list(pool.map(run, range(3)))
    assert largest_difference([expected, *found]) == 0.0


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_finite_never_counts_as_equal(value: float) -> None:
    image, gradients = everything(ordinary(5), CPU, torch.float64)
    wrong = image.clone()
    wrong[0, 0, 0, 0] = value
    assert largest_difference([(wrong, gradients), (wrong, gradients)]) == math.inf


def test_a_gradient_of_what_was_added_is_seen() -> None:
    image, gradients = everything(ordinary(5), CPU, torch.float64)
    more = {name: torch.cat([value, torch.ones_like(value[:1])]) for name, value in gradients.items()}
    assert largest_difference([(image, gradients), (image, more)]) == 1.0
