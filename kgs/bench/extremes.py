"""The published table of stiff and extreme cases: errors of images and gradients, bounds, verdicts, and times."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

import kgs.reference
from kgs.fit.outputs import versions, write_json
from kgs.renderer import GaussianRenderer
from kgs.types import Gaussians

from .extreme_cases import CASES, Case, Scene, camera, gaussians, ordinary
from .output import markdown_table, write_csv
from .timing import take_turns

__all__ = ["measure_extremes"]

PARAMETERS = ("means", "quats", "scales", "opacities", "colors")
DTYPES = {"float32": torch.float32, "float64": torch.float64}


def measure_extremes(out: Path, *, quick: bool = False, say: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, and write extremes.csv, extremes.json and extremes.md.

    Args:
        out: folder for the results, made if it is not there.
        quick: without the times.
        say: where lines for the user go.

    Returns:
        What extremes.json holds: the rows, how many bounds are missed, and versions.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for case in CASES:
        say(f"{case.name} ...")
        slowdown = None if quick else _slowdown(case)
        rows += [{**_errors(case, dtype), "time": slowdown} for dtype in DTYPES]
    for name, (stiff, treatment, difference) in _IDENTITIES.items():
        say(f"{name} ...")
        for dtype in DTYPES:
            found = difference(dtype)
            row: dict[str, Any] = {"case": name, "stiff": stiff, "treatment": treatment, "dtype": dtype}
            row |= {"forward": found, "forward_bound": 0.0, "gradient": found, "gradient_bound": 0.0}
            rows.append({**row, "verdict": "met" if found == 0.0 else "MISSED", "time": None})
    missed = sum(row["verdict"] != "met" for row in rows)
    result = {"rows": rows, "missed": missed, "versions": versions()}
    write_csv(out / "extremes.csv", rows)
    write_json(out / "extremes.json", result)
    (out / "extremes.md").write_text(table := _markdown(rows), encoding="utf-8")
    say(table)
    say(f"{missed} of {len(rows)} bounds are missed")
    return result


def _leaves(scene: Gaussians, dtype: torch.dtype) -> Gaussians:
    return Gaussians(*(getattr(scene, name).detach().to(dtype).requires_grad_() for name in PARAMETERS))


def _cast(view: PinholeCamera, dtype: torch.dtype) -> PinholeCamera:
    return PinholeCamera(view.intrinsics.to(dtype), view.extrinsics.to(dtype), view.height, view.width)


def _gradients(image: Tensor, inputs: Gaussians) -> dict[str, Tensor]:
    """Of a sum of the pixels with random weights, the same for images of one size."""
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    leaves = [getattr(inputs, name) for name in PARAMETERS]
    found = torch.autograd.grad((image * weights.to(image.dtype)).sum(), leaves)
    return dict(zip(PARAMETERS, found, strict=True))


def _render(
    scene: Scene, dtype: torch.dtype, within: AbstractContextManager[Any] | None = None, **options: Any
) -> tuple[Tensor, dict[str, Tensor]]:
    """Image and gradients, exact but for rounding, made within a context."""
    inputs = _leaves(scene[0], dtype)
    renderer = GaussianRenderer(alpha_threshold=0.0, transmittance_stop=0.0, **options)
    with within or nullcontext():
        image = renderer(inputs, _cast(scene[1], dtype)).image
        return image.detach(), _gradients(image, inputs)


def _errors(case: Case, name: str) -> dict[str, Any]:
    """One row: errors against the dense reference, which gets the rounded numbers."""
    dtype = DTYPES[name]
    cloud, view = case.scene()
    inputs = _leaves(_leaves(cloud, dtype), torch.float64)
    rounded = _cast(_cast(view, dtype), torch.float64)
    near_plane = case.options.get("near_plane", 0.01)
    exact = kgs.reference.render(inputs, rounded, None, 0.0, 0.0, near_plane)
    expected = _gradients(exact, inputs)
    image, got = _render((cloud, view), dtype, **case.options)
    forward = float((image - exact.detach()).abs().max())
    gradient = max(float((got[p] - expected[p]).abs().max() / expected[p].abs().max()) for p in PARAMETERS)
    bounds = case.bounds[name]
    return {
        "case": case.name,
        "stiff": case.stiff,
        "treatment": case.treatment,
        "dtype": name,
        "forward": forward,
        "forward_bound": bounds[0],
        "gradient": gradient,
        "gradient_bound": bounds[1],
        "verdict": "met" if forward <= bounds[0] and gradient <= bounds[1] else "MISSED",  # NaN misses
    }


def _slowdown(case: Case) -> float:
    """Time of a render with gradients over that of an ordinary scene of as many Gaussians and pixels."""
    cloud, view = case.scene()
    plain = ordinary(len(cloud), (int(view.height), int(view.width)))
    runs = {
        "case": partial(_render, (cloud, view), torch.float32, **case.options),
        "ordinary": partial(_render, plain, torch.float32),
    }
    times = take_turns(runs, 3)
    return times["case"].wall / times["ordinary"].wall


def _largest_difference(a: tuple[Tensor, dict[str, Tensor]], b: tuple[Tensor, dict[str, Tensor]]) -> float:
    """Over image and gradients; infinity where one is not finite."""
    pairs = [(a[0], b[0]), *((a[1][name], b[1][name]) for name in PARAMETERS)]
    largest = max(float((x - y).abs().max()) for x, y in pairs)
    return largest if all(bool(x.isfinite().all()) for pair in pairs for x in pair) else float("inf")


def _with(scene: Gaussians, rows: slice, **changes: float) -> Gaussians:
    """The same Gaussians with some numbers of some rows changed."""
    values = {name: getattr(scene, name).clone() for name in PARAMETERS}
    for name, value in changes.items():
        values[name][rows] = value
    return Gaussians(**values)


def _without_last(result: tuple[Tensor, dict[str, Tensor]], count: int) -> tuple[Tensor, dict[str, Tensor]]:
    return result[0], {name: gradient[:-count] for name, gradient in result[1].items()}


def _spoilt(dtype: str) -> float:
    """Every parameter of a last Gaussian in turn NaN, inf and -inf, against the scene without it."""
    plain, more = gaussians(100), gaussians(101)
    more = Gaussians(*(torch.cat([getattr(plain, p), getattr(more, p)[-1:]]) for p in PARAMETERS))
    clean = _render((plain, camera()), DTYPES[dtype])
    return max(
        _largest_difference(
            _without_last(_render((_with(more, slice(-1, None), **{p: value}), camera()), DTYPES[dtype]), 1), clean
        )
        for p in PARAMETERS
        for value in (float("nan"), float("inf"), float("-inf"))
    )


def _behind(dtype: str) -> float:
    """A thousand Gaussians more, at and behind the near plane and the camera."""
    plain, extra = gaussians(100), gaussians(1000, seed=3)
    depths = torch.tensor([-5.0, -1e-30, 0.0, 0.01], dtype=torch.float64).repeat(250)
    extra.means[:, 2] = depths.to(DTYPES[dtype]).double()
    both = Gaussians(*(torch.cat([getattr(plain, p), getattr(extra, p)]) for p in PARAMETERS))
    image, gradients = _render((both, camera()), DTYPES[dtype], near_plane=float(depths[-1].to(DTYPES[dtype])))
    of_extra = max(float(gradients[p][100:].abs().max()) for p in PARAMETERS)
    clean = _render((plain, camera()), DTYPES[dtype], near_plane=float(depths[-1].to(DTYPES[dtype])))
    return max(of_extra, _largest_difference(_without_last((image, gradients), 1000), clean))


def _transparent(dtype: str) -> float:
    """Half of the Gaussians at an opacity of 0, against the other half alone."""
    cloud = gaussians()
    half = Gaussians(*(getattr(cloud, p)[:100] for p in PARAMETERS))
    faded = _with(cloud, slice(100, None), opacities=0.0)
    return _largest_difference(
        _without_last(_render((faded, camera()), DTYPES[dtype]), 100), _render((half, camera()), DTYPES[dtype])
    )


def _autocast(dtype: str) -> float:
    before = torch.get_float32_matmul_precision()
    clean = _render(ordinary(), DTYPES[dtype])
    try:
        torch.set_float32_matmul_precision("medium")
        mixed = _render(ordinary(), DTYPES[dtype], within=torch.autocast("cpu", torch.bfloat16))
    finally:
        torch.set_float32_matmul_precision(before)
    return _largest_difference(mixed, clean)


def _threads(dtype: str) -> float:
    """Enough pairs for two threads; one and two of them, twice each."""
    scene, before = ordinary(3000, (96, 96)), torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 1, 2):
            torch.set_num_threads(count)
            results.append(_render(scene, DTYPES[dtype]))
    finally:
        torch.set_num_threads(before)
    return max(_largest_difference(results[0], other) for other in results[1:])


def _budget(dtype: str) -> float:
    """The image alone: gradients of a Gaussian are then summed in another order."""
    scene = gaussians(300, scales=60.0, opacities=0.02), camera((96, 96))
    free = _render(scene, DTYPES[dtype])[0]
    return float((_render(scene, DTYPES[dtype], max_bytes=2**21)[0] - free).abs().max())


_IDENTITIES: dict[str, tuple[str, str, Callable[[str], float]]] = {
    "not finite, one number at a time": ("NaN times 0 is NaN", "left out before anything is computed", _spoilt),
    "at and behind the near plane": ("0 and negative depths", "left out before the division", _behind),
    "opacity 0": ("ln 0", "in no list, no gradient", _transparent),
    "under autocast to bfloat16": (
        "8 bits of pixel coordinates",
        "switched off inside, forward and backward",
        _autocast,
    ),
    "one and two threads, repeated": ("sums in another order", "every sum has a fixed order", _threads),
    "under a budget of 2 MiB": ("bands of rows", "a pixel does not know its band", _budget),
}


def _markdown(rows: list[dict[str, Any]]) -> str:
    lines: dict[str, list[str]] = {}
    for row in rows:
        line = lines.setdefault(row["case"], [row["case"], row["stiff"]])
        if row["forward_bound"] == 0.0:
            line += [f"{row['forward']:.0e}, bits", ""]
        else:
            line += [
                f"{row['forward']:.0e} ({row['forward_bound']:.0e})",
                f"{row['gradient']:.0e} ({row['gradient_bound']:.0e})",
            ]
        if row["dtype"] == "float64":
            verdicts = [other["verdict"] for other in rows if other["case"] == row["case"]]
            time = "" if row["time"] is None else f"{row['time']:.1f}"
            line += ["met" if set(verdicts) == {"met"} else "MISSED", time, row["treatment"]]
    heads = ("what is stiff", "image, float32", "gradient, float32", "image, float64", "gradient, float64")
    return markdown_table(
        "Largest errors (bounds): absolute in the image, relative to the largest value in gradients; time over that of "
        "an ordinary scene of the same size",
        (*heads, "verdict", "time", "treatment"),
        lines.values(),
        first="case",
    )
