"""Stiff and extreme cases on this machine: scenes rounded to the dtype under test, their errors and their bounds.

extremes.csv has the bounds: absolute for the image, relative to the largest value for gradients; five times what the
formula reaches in an error analysis. In float64 those of needles are the reference's own error.
"""

import csv
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from kgs.geometry.cameras import to
from kgs.geometry.types import Gaussians
from kgs.renderer import GaussianRenderer

from .output import Row, markdown_table, write_results
from .scenes import DTYPES, Scene, cast, centred_camera, exact, gradients, relative_errors
from .timing import CPU

SIZE = (48, 48)
FOCAL = 60.0  # pixels
COUNT = 200
SHAPE = torch.tensor([1.0, 0.6, 0.3], dtype=torch.float64)  # of Gaussians that are not round: round ones cannot turn
NUMBERS = ("forward_float32", "gradient_float32", "forward_float64", "gradient_float64", "near_plane")


def extremes(*, out: Path) -> int:
    """Errors of stiff and extreme cases on this machine, and their bounds.

    For example:
      kgs bench extremes -o extremes
      OMP_NUM_THREADS=1 kgs bench extremes -o extremes-1

    Writes extremes.csv and extremes.md in seconds; ends with exit code 1 where a bound is missed.

    Args:
        out: folder for the results, made if it is not there.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = [errors(case, dtype) for case in cases() for dtype in DTYPES]
    missed = sum(row["verdict"] != "met" for row in rows)
    write_results(out / "extremes", rows, _markdown(rows))
    print(f"{missed} of {len(rows)} bounds are missed")
    return int(missed > 0)


def cases() -> list[Row]:
    """The lines of extremes.csv: names and words, bounds, and the near plane of the renderer and the reference."""
    lines = csv.DictReader(files(__package__).joinpath("extremes.csv").read_text("utf-8").splitlines())
    return [{**line, **{name: float(line[name]) for name in NUMBERS}} for line in lines]


def render(scene: Scene, dtype: torch.dtype, **options: Any) -> tuple[Tensor, dict[str, Tensor]]:
    """Image and gradients, exact but for rounding; `options` are the renderer's."""
    inputs, view = cast(scene, dtype)
    image = GaussianRenderer(alpha_threshold=0.0, transmittance_stop=0.0, **options)(inputs, view).image
    return image.detach(), gradients(image, inputs)


def errors(case: Row, dtype: str, device: torch.device = CPU) -> Row:
    """One row: errors on a device against the dense reference on the CPU, which gets the rounded numbers."""
    cloud, view = SCENES[case["case"]]()
    near_plane = case["near_plane"]
    expected, expected_gradients = exact(cast((cloud, view), DTYPES[dtype]), near_plane)
    image, slopes = render((cloud.to(device), to(view, device)), DTYPES[dtype], near_plane=near_plane)
    slopes = {name: gradient.cpu() for name, gradient in slopes.items()}
    worst = {
        "forward": float((image.cpu() - expected).abs().max()),
        "gradient": relative_errors(slopes, expected_gradients).max().item(),
    }
    row = {name: case[name] for name in ("case", "stiff", "treatment")} | {"dtype": dtype}
    for name, error in worst.items():
        row |= {name: error, f"{name}_bound": case[f"{name}_{dtype}"]}
    met = all(error <= row[f"{name}_bound"] for name, error in worst.items())  # NaN misses
    return row | {"verdict": "met" if met else "MISSED"}


def _markdown(rows: list[Row]) -> str:
    lines = []
    for low, high in zip(rows[::2], rows[1::2], strict=True):  # float32, float64
        parts = product((low, high), ("forward", "gradient"))
        cells = [f"{row[part]:.0e} ({row[f'{part}_bound']:.0e})" for row, part in parts]
        verdict = "met" if low["verdict"] == high["verdict"] == "met" else "MISSED"
        lines.append([low["case"], low["stiff"], *cells, verdict, low["treatment"]])
    heads = ("what is stiff", "image, float32", "gradient, float32", "image, float64", "gradient, float64")
    return markdown_table("Errors (bounds), gradients relative", (*heads, "verdict", "treatment"), lines, first="case")


def gaussians(count: int = COUNT, seed: int = 0, **changes: Any) -> Gaussians:
    """An ordinary cloud before the camera: two to six units deep, one to five pixels wide, harmonics of degree 1."""
    generator = torch.Generator().manual_seed(seed)
    depth = _uniform(2.0, 6.0, count, generator=generator)
    xy = _uniform(-1.1, 1.1, count, 2, generator=generator) * (SIZE[1] / 2 / FOCAL)
    values: dict[str, Tensor] = {
        "means": torch.cat([xy * depth[:, None], depth[:, None]], 1),
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "scales": _uniform(1.0, 5.0, count, 3, generator=generator) * depth[:, None] / FOCAL,
        "opacities": _uniform(0.05, 0.9, count, generator=generator),
        "colors": 0.5 * torch.randn(count, 4, 3, generator=generator, dtype=torch.float64),
    }
    for name, value in changes.items():
        values[name] = torch.as_tensor(value, dtype=torch.float64).expand_as(values[name]).clone()
    return Gaussians(**values)


def ordinary(count: int = COUNT, size: tuple[int, int] = SIZE, **changes: Any) -> Scene:
    """An ordinary cloud and its camera; `changes` make a case of it."""
    return gaussians(count, **changes), centred_camera(size, FOCAL)


def _uniform(low: float, high: float, *shape: int, generator: torch.Generator | None = None) -> Tensor:
    generator = generator or torch.Generator().manual_seed(1)
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def _off_axis() -> Scene:
    tangent = _uniform(0.8, 5.0, COUNT)
    angle = _uniform(0, 2 * math.pi, COUNT)
    depth = gaussians().means[:, 2]
    rays = torch.stack([tangent * angle.cos(), tangent * angle.sin(), torch.ones_like(depth)], 1)
    return ordinary(means=rays * depth[:, None], scales=_uniform(0.1, 3.0, COUNT, 3))


def _layers(count: int, opacity: float, size: tuple[int, int]) -> Scene:
    means = pad(torch.linspace(2.0, 6.0, count, dtype=torch.float64)[:, None], (2, 0))
    return ordinary(count, size, means=means, scales=2.0 * means[:, 2:] * SHAPE, opacities=opacity)


def _beside_the_camera() -> Scene:
    poles = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 1e-3], [0.0, 1.0, 1e-3], [1e-20, 0.0, 1.0]], dtype=torch.float64)
    means = poles.repeat(COUNT // 4, 1) * _uniform(0.0101, 0.05, COUNT, 1)
    means[:, 2] = means[:, 2].clamp_min(0.0101)
    colors = torch.randn(COUNT, 16, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    cloud = gaussians(means=means, scales=1e-3 * SHAPE, opacities=_uniform(0.05, 0.3, COUNT))
    return replace(cloud, colors=0.3 * colors), centred_camera(SIZE, FOCAL)


def _far_from_the_origin() -> Scene:
    shift = 5e3 * torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64)
    view = centred_camera(SIZE, FOCAL)
    view.extrinsics[:, :3, 3] = -shift
    return gaussians(means=gaussians().means + shift), view


_CLOUD = gaussians()
_THIN = 0.02 / FOCAL * _CLOUD.means[:, 2:]  # a fiftieth of a pixel: what is seen of it is the dilation
_ANY = torch.cartesian_prod(*[torch.tensor([0.0, 1e-45, 1e-30, 1e-6, 1.0, 1e3], dtype=torch.float64)] * 3)
_NEAR = 0.01 * (1 + torch.logspace(-6, 1, COUNT, dtype=torch.float64)[:, None])
_RAYS = pad(_uniform(-0.4, 0.4, COUNT, 2), (0, 1), value=1.0)
_NORMS = torch.logspace(-30, 30, COUNT, dtype=torch.float64).index_fill(0, torch.arange(0, COUNT, 20), 0.0)
_PLANE = pad(_CLOUD.means[:, :2], (0, 1), value=4.0)
SCENES: dict[str, Callable[[], Scene]] = {
    "ordinary": ordinary,
    "at the near plane": partial(ordinary, means=_RAYS * _NEAR, scales=0.05 * SHAPE),
    "far off axis": _off_axis,
    **{
        f"needles, {r:.0e} : 1": partial(ordinary, scales=_THIN * torch.tensor([r, 1.0, 1.0]), opacities=0.3)
        for r in (1e3, 1e5, 1e6)
    },
    "pancakes, 1e+06 : 1": partial(ordinary, scales=_THIN * torch.tensor([1e6, 1e6, 1.0]), opacities=0.3),
    "scales 0 to 1000": partial(ordinary, len(_ANY), scales=_ANY, opacities=_uniform(0.02, 0.1, len(_ANY))),
    "a hundredth of a pixel": partial(ordinary, scales=0.01 / 20 * SHAPE),
    "a thousand pixels": partial(ordinary, scales=60.0 * SHAPE, opacities=0.05),
    "opacities 1e-30, 1 and 1.25": partial(ordinary, opacities=torch.tensor([1e-30, 1.0, 1.25, 0.5] * (COUNT // 4))),
    "20 000 faint layers": partial(_layers, 20_000, 1 / 255, (8, 8)),
    "opaque wall": partial(_layers, COUNT, 0.999, SIZE),
    "one depth for all": partial(ordinary, means=_PLANE),
    "quaternions of norm 0 to 1e30": partial(ordinary, quats=_CLOUD.quats * _NORMS[:, None]),
    "beside the camera": _beside_the_camera,
    **{f"world unit {u:.0e}": partial(ordinary, means=u * _CLOUD.means, scales=u * _CLOUD.scales) for u in (1e-6, 1e6)},
    "5000 units from the origin": _far_from_the_origin,
    **{f"image of {w} x {h}": partial(ordinary, COUNT, (h, w)) for h, w in ((1, 1), (17, 15), (1, 4097))},
}
