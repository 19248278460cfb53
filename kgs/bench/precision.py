"""Error (float32 rounding of the scene included) against run time of each knob, against the dense reference."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kgs.geometry.types import Gaussians, RasterOptions
from kgs.stages import composite, project

from .output import Row, markdown_table, write_plot, write_results
from .scenes import DTYPES, PARAMETERS, Scene, cast, centred_camera, exact, gradients, layered_scene, relative_errors
from .timing import take_turns

LEVELS = {"half a grey level, 2e-3": (2e-3, "k--"), "float32 floor, 1.4e-6": (1.4e-6, "k:")}


@dataclass(frozen=True)
class Setting:
    """One way to render; options and defaults are those of the renderer and of `composite`."""

    alpha_threshold: float = RasterOptions.alpha_threshold
    transmittance_stop: float = RasterOptions.transmittance_stop
    dtype: str = "float32"
    tile_size: int = 8  # that of both backends
    chunk_size: int | None = None
    backend: str = "auto"


DEFAULT = Setting()
EXACT = Setting(alpha_threshold=0.0, transmittance_stop=0.0)
EXACT64 = replace(EXACT, dtype="float64")
_ALPHAS = (0.0, 1e-4, 1 / 1024, 1 / 512, 1 / 255, 1 / 128)
_GRADIENTS = ("gradient", *(f"gradient_{name}" for name in PARAMETERS))
KNOBS = {
    "alpha threshold 0 to 1/128, stop 0": [replace(EXACT, alpha_threshold=a) for a in _ALPHAS],
    "alpha threshold 0 to 1/128, stop 1e-4": [replace(DEFAULT, alpha_threshold=a) for a in _ALPHAS],
    "stop 0 to 1e-2, alpha threshold 0": [replace(EXACT, transmittance_stop=t) for t in (0.0, 1e-6, 1e-4, 1e-3, 1e-2)],
    "torch: exact, default": [replace(EXACT, backend="torch"), replace(DEFAULT, backend="torch")],
    "float64: exact, default": [EXACT64, replace(DEFAULT, dtype="float64")],
    "tiles 4 to 64": [replace(DEFAULT, tile_size=t) for t in (4, 8, 16, 32, 64)],
    "chunks 4 to 256": [replace(DEFAULT, chunk_size=k) for k in (4, 16, 64, 256)],
}
_LOOKS = ("o-", "s-", "^-", "p-", "D-", "v-", "x-", "k*")  # of the knobs and the default in the plots
_COLUMNS = {
    "default": DEFAULT,
    "default, torch": replace(DEFAULT, backend="torch"),
    "alpha 1/1024": replace(DEFAULT, alpha_threshold=1 / 1024),
    "exact, float32": EXACT,
    "exact, float64": EXACT64,
}


def precision(*, out: Path, quick: bool = False) -> None:
    """Errors of images, gradients and footprints against the time they take, for each knob of the renderer.

    For example:
      kgs bench precision -o precision
      kgs bench precision -o precision --quick

    Writes precision.csv and .md, render.png and gradients.png in 5 minutes, with --quick in half a minute.

    Args:
        out: folder for the results, made if it is not there.
        quick: small images with few Gaussians.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, make in SCENES.items():
        print(f"{name} ...")
        count, size, repeats = (300, 48, 1) if quick else (3000, 96, 3)
        rows += [{"scene": name, **row} for row in make(count, size).measure(repeats)]
    _plot(out / "render.png", rows, "max_error", "forward_s", "largest error of the image, at least 1e-8")
    _plot(out / "gradients.png", rows, "gradient", "backward_s", "relative error of a gradient, at least 1e-8")
    write_results(out / "precision", rows, _markdown(rows))


class Measured:
    """A scene in float64 that is rendered in both dtypes, black background."""

    def __init__(self, scene: Scene, near_plane: float = RasterOptions.near_plane) -> None:
        self.near_plane = near_plane
        self.inputs = {name: cast(scene, dtype) for name, dtype in DTYPES.items()}

    def image(self, s: Setting, grad: bool = False) -> Tensor:
        """The image alone, with or without its graph."""
        options = RasterOptions(
            tile_size=s.tile_size,
            near_plane=self.near_plane,
            alpha_threshold=s.alpha_threshold,
            transmittance_stop=s.transmittance_stop,
        )
        with torch.set_grad_enabled(grad):
            projected = project(*self.inputs[s.dtype], options=options, backend=s.backend)
            drawn = composite(projected, projected.colors, options=options, chunk_size=s.chunk_size, backend=s.backend)
            return drawn.features

    def backward(self, s: Setting) -> dict[str, Tensor]:
        """The gradients of the image."""
        return gradients(self.image(s, grad=True), self.inputs[s.dtype][0])

    def measure(self, repeats: int) -> list[Row]:
        """One row per setting: the setting, errors, median seconds and their range."""
        expected, expected_gradients = exact(self.inputs["float64"], self.near_plane)
        settings = list(dict.fromkeys(s for knob in KNOBS.values() for s in knob))
        forward = take_turns({str(s): partial(self.image, s) for s in settings}, repeats + 2)
        backward = take_turns({str(s): partial(self.backward, s) for s in settings}, repeats)
        rows = []
        for s in settings:
            error = (self.image(s) - expected).abs()
            parts = relative_errors(self.backward(s), expected_gradients)
            row = {**asdict(s), "max_error": float(error.max()), "rmse": float(error.square().mean().sqrt())}
            row |= dict(zip(_GRADIENTS, [parts.max().item(), *parts.tolist()], strict=True))
            for name, times in (("forward", forward[str(s)]), ("backward", backward[str(s)])):
                row |= {f"{name}_s": times.wall, f"{name}_best_s": times.best, f"{name}_worst_s": times.worst}
            rows.append(row)
        return rows


def _ordinary(count: int, size: int, unit: float = 1.0, far: float = 0.0) -> Measured:
    """As training leaves it; in other units, or turned and moved `far` from the origin together with the camera."""
    model, camera = layered_scene(count, (size, size))
    with torch.no_grad():
        g = model.double()()
    camera = centred_camera((size, size), float(camera.fx))
    pose = torch.eye(4, dtype=torch.float64)
    if far:
        pose[:3, :3] = torch.tensor([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]], dtype=torch.float64)
        pose[:3, 3] = -pose[:3, :3] @ (far * torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64))
    camera.extrinsics.copy_(pose)
    means = (unit * g.means - pose[:3, 3]) @ pose[:3, :3]
    return Measured((replace(g, means=means, scales=unit * g.scales), camera), RasterOptions.near_plane * unit)


def _random(count: int, size: int, angle: float = 60.0, **changes: tuple[float, float]) -> Measured:
    """A cloud that fills the picture; `spread`: longest standard deviation in pixels, `ratios`: to the others."""
    bounds = {"depths": (2.0, 6.0), "spread": (1.0, 5.0), "ratios": (1.0, 4.0), "opacities": (0.05, 0.95), **changes}
    n = count // 2
    rng = np.random.default_rng([7, count])
    half = math.tan(math.radians(angle) / 2)
    shortest, longest = bounds["spread"]
    minimum, maximum = bounds["ratios"]
    z = rng.uniform(*bounds["depths"], (n, 1))
    scales = shortest * (longest / shortest) ** rng.random((n, 1)) * z * 2 * half / size
    scales = np.concatenate([scales, scales / (minimum * (maximum / minimum) ** rng.random((n, 2)))], 1)
    means = np.concatenate([rng.uniform(-1.1, 1.1, (n, 2)) * half * z, z], 1)
    opacities = rng.uniform(*bounds["opacities"], n)
    parts = (means, rng.normal(size=(n, 4)), scales, opacities, rng.uniform(0, 1, (n, 3)))
    return Measured((Gaussians(*map(torch.from_numpy, parts)), centred_camera((size, size), size / 2 / half)))


SCENES: dict[str, Callable[[int, int], Measured]] = {
    "ordinary": _ordinary,
    "3-view": partial(_random, spread=(4.0, 30.0), ratios=(2.0, 50.0), opacities=(0.1, 0.7)),
    "needles": partial(_random, spread=(5.0, 40.0), ratios=(1e3, 1e6)),
    "haze": partial(_random, spread=(8.0, 30.0), opacities=(0.001, 0.02)),
    "opaque wall": partial(_random, depths=(3.0, 3.1), spread=(2.0, 6.0), opacities=(0.95, 1.0)),
    "far origin": partial(_ordinary, far=5e3),
    "tiny units": partial(_ordinary, unit=1e-4),
    "wide angle": partial(_random, angle=120.0),
}


def _find(rows: list[Row], scene: str, setting: Setting) -> Row:
    return next(row for row in rows if row["scene"] == scene and row.items() >= asdict(setting).items())


def _markdown(rows: list[Row]) -> str:
    lines = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        of_scene = [_find(rows, scene, setting) for setting in _COLUMNS.values()]
        lines.append([scene, *(f"{row['max_error']:.1e} / {row['gradient']:.1e}" for row in of_scene)])
    return markdown_table("Largest error: image / gradient, relative to its largest value", _COLUMNS, lines)


def _plot(path: Path, rows: list[Row], error: str, seconds: str, label: str) -> None:
    panels: dict[str, dict[str, tuple[Any, str]]] = {}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        lines = panels[scene] = {}
        for (knob, settings), marker in zip([*KNOBS.items(), ("the default", [DEFAULT])], _LOOKS, strict=True):
            of_knob = [_find(rows, scene, setting) for setting in settings]
            lines[knob] = [(1e3 * row[seconds], max(row[error], 1e-8)) for row in of_knob], marker
        times = [x for points, _ in lines.values() for x, _ in points]
        lines |= {name: ([(min(times), y), (max(times), y)], look) for name, (y, look) in LEVELS.items()}
    write_plot(path, panels, 2, xlabel="wall time [ms]", ylabel=label, ylim=(6e-9, 2))
