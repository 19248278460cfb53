"""Error against run time: what each knob of the renderer costs in accuracy, in the image and in its gradients.

Errors are against `kgs.reference`: dense, in float64, both thresholds 0. Scenes are drawn in float64 and rounded once
for float32, so that rounding is part of the float32 error. The first-order footprint itself is measured against the
moments of the perspective projection (M. Zwicker et al., "EWA Volume Splatting", 2001).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

import kgs.reference
from kgs.fit.outputs import versions, write_json
from kgs.projection import project
from kgs.raster import composite
from kgs.types import Gaussians

from .output import markdown_table, write_csv
from .scenes import layered_scene
from .timing import take_turns

__all__ = ["DEFAULT", "EXACT", "KNOBS", "SCENES", "Setting", "measure_precision"]

FLOAT32_FLOOR, HALF_GREY_LEVEL = 1.4e-6, 2e-3
PARAMETERS = ("means", "quats", "scales", "opacities", "colors")
SIGMAS, ANGLES = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.2, 0.3), (0, 20, 40, 55)
NODES = 5  # the outermost lies 2.9 sigma out: in front of the camera for all of SIGMAS
NEAR_PLANE = 0.01


@dataclass(frozen=True)
class Setting:
    """One way to render, in the options of the renderer and of `composite`; the defaults are theirs."""

    alpha_threshold: float = 1 / 255
    transmittance_stop: float = 1e-4
    dtype: str = "float32"
    tile_size: int = 8
    chunk_size: int | None = None


DEFAULT, EXACT = Setting(), Setting(alpha_threshold=0.0, transmittance_stop=0.0)
EXACT64 = replace(EXACT, dtype="float64")
_SHAPES: dict[str, list[dict[str, Any]]] = {
    "tiles 4 to 16": [{"tile_size": t} for t in (4, 8, 16)],
    "tiles 4 to 64": [{"tile_size": t} for t in (4, 8, 16, 32, 64)],
    "chunks 4 to 256": [{"chunk_size": k} for k in (4, 16, 64, 256)],
}
_ALPHAS = (0.0, 1e-4, 1 / 1024, 1 / 512, 1 / 255, 1 / 128)
KNOBS = {
    "alpha threshold 0 to 1/128, stop 0": [replace(EXACT, alpha_threshold=a) for a in _ALPHAS],
    "alpha threshold 0 to 1/128, stop 1e-4": [replace(DEFAULT, alpha_threshold=a) for a in _ALPHAS],
    "stop 0 to 1e-2, alpha threshold 0": [replace(EXACT, transmittance_stop=t) for t in (0.0, 1e-6, 1e-4, 1e-3, 1e-2)],
    "float64: exact, default": [EXACT64, replace(DEFAULT, dtype="float64")],
    **{name: [replace(DEFAULT, **shape) for shape in _SHAPES[name]] for name in ("tiles 4 to 64", "chunks 4 to 256")},
}
_COLUMNS = {"default": DEFAULT, "alpha 1/1024": replace(DEFAULT, alpha_threshold=1 / 1024)}
_COLUMNS |= {"exact, float32": EXACT, "exact, float64": EXACT64}


def measure_precision(out: Path, *, quick: bool = False, say: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, and write precision.csv, .json and .md, projection.csv, render.png, gradients.png and projection.png.

    Args:
        out: folder for the results, made if it is not there.
        quick: small images with few Gaussians: half a minute instead of five.
        say: where lines for the user go.

    Returns:
        What precision.json holds.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows, flatness = [], {}
    for name, make in SCENES.items():
        say(f"{name} ...")
        scene = make(*((300, 48) if quick else (3000, 96)))
        rows += [{"scene": name, **row} for row in scene.measure(repeats=1 if quick else 3)]
        flatness[name] = scene.flatness()
    projection = _projection_errors()
    result: dict[str, Any] = {"rows": rows, "flatness": flatness, "projection": projection}
    result |= {"threads": torch.get_num_threads(), "versions": versions()}
    for name, lines in (("precision", rows), ("projection", projection)):
        write_csv(out / f"{name}.csv", lines)
    write_json(out / "precision.json", result)
    (out / "precision.md").write_text(table := _markdown(rows, flatness, projection))
    _plot_scenes(out / "render.png", rows, "max_error", "forward_s", "largest error of the image")
    _plot_scenes(out / "gradients.png", rows, "gradient", "backward_s", "largest relative error of a gradient")
    _plot_projection(out / "projection.png", projection)
    say(table)
    return result


class _Scene:
    """Gaussians in float64 before one camera, black background."""

    def __init__(self, gaussians: Gaussians, c: PinholeCamera, near_plane: float = NEAR_PLANE) -> None:
        self.near_plane, self.inputs = near_plane, {}
        for dtype in (torch.float32, torch.float64):
            leaves = Gaussians(*(getattr(gaussians, p).detach().to(dtype).requires_grad_() for p in PARAMETERS))
            camera = PinholeCamera(c.intrinsics.to(dtype), c.extrinsics.to(dtype), c.height, c.width)
            self.inputs[str(dtype).removeprefix("torch.")] = leaves, camera
        shape, generator = (1, 3, int(c.height), int(c.width)), torch.Generator().manual_seed(0)
        self.weights = torch.randn(shape, generator=generator, dtype=torch.float64)

    def image(self, s: Setting, grad: bool = False) -> Tensor:
        gaussians, camera = self.inputs[s.dtype]
        options = {name: value for name, value in asdict(s).items() if name != "dtype"}
        with torch.set_grad_enabled(grad):
            projected = project(gaussians, camera, near_plane=self.near_plane, alpha_threshold=s.alpha_threshold)
            return composite(projected, projected.colors, **options).features

    def backward(self, s: Setting, image: Tensor | None = None) -> dict[str, Tensor]:
        """Gradients of a sum of the pixels with random weights, the same for all images."""
        image = self.image(s, grad=True) if image is None else image
        loss = (image * self.weights.to(image.dtype)).sum()
        leaves = [getattr(self.inputs[s.dtype][0], p) for p in PARAMETERS]
        return dict(zip(PARAMETERS, torch.autograd.grad(loss, leaves), strict=True))

    def measure(self, repeats: int) -> list[dict[str, Any]]:
        """One row a setting: the setting, errors, median seconds and their range."""
        exact = kgs.reference.render(*self.inputs["float64"], None, 0.0, 0.0, self.near_plane)
        gradients = self.backward(EXACT64, exact)
        settings = list(dict.fromkeys(s for knob in KNOBS.values() for s in knob))
        forward = take_turns({str(s): partial(self.image, s) for s in settings}, repeats + 2)
        backward = take_turns({str(s): partial(self.backward, s) for s in settings}, repeats)
        rows = []
        for s in settings:
            error = (self.image(s) - exact.detach()).abs()
            parts = {p: (g - gradients[p]).abs().max() / gradients[p].abs().max() for p, g in self.backward(s).items()}
            row = {**asdict(s), "max_error": float(error.max()), "rmse": float(error.square().mean().sqrt())}
            row |= {"gradient": float(max(parts.values())), **{f"gradient_{p}": float(g) for p, g in parts.items()}}
            for name, times in (("forward", forward[str(s)]), ("backward", backward[str(s)])):
                row |= {f"{name}_s": times.wall, f"{name}_best_s": times.best, f"{name}_worst_s": times.worst}
            rows.append(row)
        return rows

    def flatness(self) -> dict[str, float]:
        """Largest difference between float32 images that should be the same."""
        found = {}
        for start, label in ((EXACT, "exact"), (DEFAULT, "default")):
            for name, shapes in _SHAPES.items():
                images = torch.stack([self.image(replace(start, **shape)) for shape in shapes])
                found[f"{name}, {label}"] = float((images.amax(0) - images.amin(0)).max())
        return found


def _ordinary(count: int, size: int, unit: float = 1.0, far: float = 0.0) -> _Scene:
    """As training leaves it; in other units, or turned and moved `far` from the origin together with the camera."""
    model, camera = layered_scene(count, (size, size))
    with torch.no_grad():
        g = model.double()()
    pose = torch.eye(4, dtype=torch.float64)
    if far:
        pose[:3, :3] = torch.tensor([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]], dtype=torch.float64)
        pose[:3, 3] = -pose[:3, :3] @ (far * torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64))
    means = (unit * g.means - pose[:3, 3]) @ pose[:3, :3]
    camera = PinholeCamera(camera.intrinsics.double(), pose[None], camera.height, camera.width)
    return _Scene(Gaussians(means, g.quats, unit * g.scales, g.opacities, g.colors), camera, NEAR_PLANE * unit)


def _random(count: int, size: int, angle: float = 60.0, **changes: tuple[float, float]) -> _Scene:
    """A cloud that fills the picture; `spread`: longest standard deviation in pixels, `ratios`: to the others."""
    bounds = {"depths": (2.0, 6.0), "spread": (1.0, 5.0), "ratios": (1.0, 4.0), "opacities": (0.05, 0.95), **changes}
    n, rng, half = count // 2, np.random.default_rng([7, count]), math.tan(math.radians(angle) / 2)
    (shortest, longest), (least, most) = bounds["spread"], bounds["ratios"]
    z = rng.uniform(*bounds["depths"], (n, 1))
    scales = shortest * (longest / shortest) ** rng.random((n, 1)) * z * 2 * half / size
    scales = np.concatenate([scales, scales / (least * (most / least) ** rng.random((n, 2)))], 1)
    means = np.concatenate([rng.uniform(-1.1, 1.1, (n, 2)) * half * z, z], 1)
    opacities = rng.uniform(*bounds["opacities"], n)
    parts = (means, rng.normal(size=(n, 4)), scales, opacities, rng.uniform(0, 1, (n, 3)))
    return _Scene(Gaussians(*(torch.from_numpy(part) for part in parts)), _camera(size, size / 2 / half))


def _camera(size: int, focal: float) -> PinholeCamera:
    """Square and centred, at the origin, float64."""
    matrix = torch.diag(torch.tensor([focal, focal, 1.0, 1.0], dtype=torch.float64))
    matrix[:2, 2] = (size - 1) / 2
    return PinholeCamera(matrix[None], torch.eye(4).double()[None], torch.tensor([size]), torch.tensor([size]))


SCENES: dict[str, Callable[[int, int], _Scene]] = {
    "ordinary": _ordinary,
    "3-view": partial(_random, spread=(4.0, 30.0), ratios=(2.0, 50.0), opacities=(0.1, 0.7)),
    "needles": partial(_random, spread=(5.0, 40.0), ratios=(1e3, 1e6)),
    "haze": partial(_random, spread=(8.0, 30.0), opacities=(0.001, 0.02)),
    "opaque wall": partial(_random, depths=(3.0, 3.1), spread=(2.0, 6.0), opacities=(0.95, 1.0)),
    "far origin": partial(_ordinary, far=5e3),
    "tiny units": partial(_ordinary, unit=1e-4),
    "wide angle": partial(_random, angle=120.0),
}


def _projection_errors() -> list[dict[str, float]]:
    """First-order moments against exact ones, one row an angle off axis and sigma / z."""
    cases = [(angle, sigma) for angle in ANGLES for sigma in SIGMAS]
    n, size, focal = len(cases), 2048, 512.0
    centres = torch.tensor([[math.tan(math.radians(angle)), 0, 1] for angle, _ in cases], dtype=torch.float64)
    scales = torch.tensor([[sigma] * 3 for _, sigma in cases], dtype=torch.float64)
    quats, ones = torch.eye(4).double()[:1].expand(n, 4), torch.ones(n, 3).double()
    drawn = project(Gaussians(centres, quats, scales, ones[:, 0], ones), _camera(size, focal), eps2d=0.0)
    rows = []
    for k, (angle, sigma) in enumerate(cases):
        first_order = drawn.factors[k] @ drawn.factors[k].mT / focal**2
        mean, exact = _moments(centres[k], sigma, NODES)
        shift = mean - (drawn.means2d[k] - (size - 1) / 2) / focal
        error = float((exact - first_order).norm() / exact.norm())
        _, coarse = _moments(centres[k], sigma, NODES - 1)
        row = {"angle": angle, "sigma_over_z": sigma, "covariance_error": error}
        row["mean_error_sigmas"] = float((shift @ torch.linalg.inv(first_order) @ shift).sqrt())
        rows.append({**row, "quadrature_change": abs(float((coarse - first_order).norm() / coarse.norm()) / error - 1)})
    return rows


def _moments(centre: Tensor, sigma: float, nodes: int) -> tuple[Tensor, Tensor]:
    """Mean `(2,)` and covariance `(2, 2)` of (x / z, y / z), (x, y, z) normal, by Gauss-Hermite quadrature."""
    knots, weights = (torch.from_numpy(a) for a in np.polynomial.hermite_e.hermegauss(nodes))
    points = centre + sigma * torch.cartesian_prod(knots, knots, knots)
    share = torch.cartesian_prod(weights, weights, weights).prod(1) / weights.sum() ** 3
    plane = points[:, :2] / points[:, 2:]
    mean = share @ plane
    return mean, (share[:, None] * (plane - mean)).mT @ (plane - mean)


def _find(rows: list[dict[str, Any]], scene: str, setting: Setting) -> dict[str, Any]:
    return next(row for row in rows if row["scene"] == scene and row.items() >= asdict(setting).items())


def _markdown(rows: list[dict[str, Any]], flatness: dict[str, Any], projection: list[dict[str, float]]) -> str:
    errors, angles = [], []
    for scene in flatness:
        found = [_find(rows, scene, setting) for setting in _COLUMNS.values()]
        errors.append([scene, *(f"{row['max_error']:.1e} / {row['gradient']:.1e}" for row in found)])
    flat = [[scene, *(f"{value:.1e}" for value in values.values())] for scene, values in flatness.items()]
    for angle in ANGLES:
        found = [row for row in projection if row["angle"] == angle]
        angles.append([f"{angle}°", *(f"{row['covariance_error']:.1e}" for row in found)])
    changes = [max(row["quadrature_change"] for row in projection if row["sigma_over_z"] == sigma) for sigma in SIGMAS]
    angles.append([f"change with {NODES - 1} for {NODES} quadrature nodes", *(f"{value:.0e}" for value in changes)])
    return (
        markdown_table(
            "Largest error of the image / of a gradient, the latter over its largest value", _COLUMNS, errors
        )
        + markdown_table("Largest difference between float32 images", next(iter(flatness.values())), flat)
        + markdown_table(
            "First-order footprint: relative error of the covariance by angle and sigma / z", SIGMAS, angles
        )
    )


def _plot_scenes(path: Path, rows: list[dict[str, Any]], error: str, seconds: str, label: str) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, ScalarFormatter

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure = Figure(figsize=(14, 7.5), layout="constrained")
    axes = figure.subplots(2, math.ceil(len(scenes) / 2), sharey=True, squeeze=False)
    for axis, scene in zip(axes.flat, scenes, strict=False):
        for (knob, settings), marker in zip(KNOBS.items(), "os^Dvx", strict=True):
            found = (_find(rows, scene, setting) for setting in settings)
            points = [(1e3 * row[seconds], max(row[error], 1e-8)) for row in found]
            axis.loglog(*zip(*points, strict=True), f"{marker}-", markersize=4, linewidth=1, alpha=0.8, label=knob)
        row = _find(rows, scene, DEFAULT)
        axis.loglog(1e3 * row[seconds], row[error], "k*", markersize=13, label="the default", zorder=5)
        axis.axhline(HALF_GREY_LEVEL, color="grey", linestyle="--", label="half a grey level, 2e-3")
        axis.axhline(FLOAT32_FLOOR, color="grey", linestyle=":", label="float32 floor, 1.4e-6")
        axis.set(title=scene, xlabel="wall time [ms]", ylim=(6e-9, 2))
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set(major_formatter=ScalarFormatter(), minor_formatter="")
        axis.grid(alpha=0.3)
    figure.supylabel(f"{label}, at least 1e-8")
    figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    figure.savefig(path, dpi=100)


def _plot_projection(path: Path, rows: list[dict[str, float]]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.8), layout="constrained")
    names = {"covariance_error": "relative error of the covariance", "mean_error_sigmas": "error of the mean [sigma]"}
    for axis, (column, label) in zip(figure.subplots(1, 2), names.items(), strict=True):
        for angle in ANGLES[column == "mean_error_sigmas" :]:  # on the axis the mean is exact
            axis.loglog(SIGMAS, [row[column] for row in rows if row["angle"] == angle], "o-", label=f"{angle}°")
        axis.set(xlabel="sigma / z", ylabel=label)
        axis.legend(title="off axis")
    figure.savefig(path, dpi=120)
