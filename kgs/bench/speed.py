"""Time and memory of the renderer and of a training step on this machine, and how they grow."""

import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kgs._support.machine import check_device, peak_rss_mb
from kgs.backends import Backend, get_backend
from kgs.backends.torch.binning import bin_to_tiles
from kgs.fit.adam import Adam
from kgs.geometry.cameras import to
from kgs.geometry.types import Gaussians
from kgs.losses import photometric_loss, target_moments
from kgs.renderer import GaussianRenderer
from kgs.stages import composite, project

from .output import Row, markdown_table, write_plot, write_results
from .scenes import PARAMETERS, layered_scene
from .timing import CPU, Case, busy_processes, seconds_of_exp, take_turns, time_parts

SIZE = (378, 504)
# The targets of kgs on two cores, by count of Gaussians: how many times faster than torch numba is, the most MiB over
# what importing takes, and the most wall time beside two busy processes in that of a quiet machine.
TARGETS = {
    "forward + backward": {10_000: 4.0, 50_000: 4.0, 200_000: 3.5},
    "training step": {10_000: 4.0, 50_000: 4.0, 200_000: 3.3},
    "peak memory": {10_000: 60.0, 50_000: 140.0, 200_000: 400.0},
    "busy": {10_000: 3.0, 50_000: 3.0, 200_000: 3.0},
}


def speed(*, out: Path, quick: bool = False, device: str = "cpu") -> None:
    """Time and memory of renders and training steps on this machine: of torch and kernels, by stage, by what is asked.

    For example:
      kgs bench speed -o speed
      kgs bench speed -o speed --quick --device cuda

    Writes speed.csv, speed.md and scaling.png in minutes, with --quick in tens of seconds.

    Args:
        out: folder for the results, made if it is not there.
        quick: fewer Gaussians and repetitions.
        device: where to render: cpu, cuda, cuda:1, ...
    """
    where = check_device(device)
    out.mkdir(parents=True, exist_ok=True)
    repeats = 3 if quick else 7
    counts = (2_000, 10_000) if quick else (10_000, 50_000, 200_000)
    sizes = [(SIZE[0] // k, SIZE[1] // k) for k in (3, 2, 1)]
    scaled = [(count, SIZE) for count in (counts[0] // 2, *counts)] + [(counts[0], size) for size in sizes]
    plan = [(table, count, SIZE) for count in counts for table in ("main", "busy", "stages")]
    plan += [("left out", counts[1], SIZE), *(("scaling", *scene) for scene in dict.fromkeys(scaled))]
    unit = seconds_of_exp(where)
    rows = []
    for table, count, (height, width) in plan:
        print(f"{table}: {count} Gaussians at {width}x{height} ...")
        cases = Cases(count, (height, width), where)
        with busy_processes(2 if table == "busy" else 0):
            if table == "stages":
                times_of = time_parts(cases.stages, repeats, where)
            else:
                times_of = take_turns(cases.of(table), repeats, where)
        of_scene = {"gaussians": count, "height": height, "width": width, "pairs_millions": cases.pairs}
        for name, times in times_of.items():
            case, _, backend = name.partition(", by ")
            row: Row = {"table": table, "case": case, "backend": backend or "auto", **of_scene, "repeats": repeats}
            row |= {f"{key}_s": value for key, value in times._asdict().items()}
            row["wall_in_exp_per_pair"] = times.wall / (cases.pairs * 1e6) / unit
            rows.append(row)
    alone = backends(where) if where.type == "cpu" else []
    memory = {backend: {count: _memory_of_its_own(count, backend) for count in counts} for backend in alone}
    points = _scaling([row for row in rows if row["table"] == "scaling"], counts[0])
    exponents = {name: _exponent(of) for name, of in points.items()}
    panels = {f"by {name}": {"forward + backward": (of, "o-")} for name, of in points.items()}
    write_plot(out / "scaling.png", panels, ylabel="wall time [s]")
    write_results(out / "speed", rows, _markdown(rows, memory, unit, exponents))


def backends(device: torch.device) -> list[str]:
    """Those that can be compared."""
    return list(dict.fromkeys(["torch", get_backend("auto", device).name]))


class Cases:
    """One scene and what there is to time on it; `pairs`: of pixel and Gaussian in its tiles' lists, in millions."""

    def __init__(self, count: int, size: tuple[int, int], device: torch.device, backend: str = "auto") -> None:
        model, camera = layered_scene(count, size)
        self.count = count
        self.device = device
        self.renderer = GaussianRenderer(backend=backend)
        self.model = model.to(device)
        self.camera = to(camera, device)
        generator = torch.Generator().manual_seed(0)
        self.weights = torch.rand(1, 3, *size, generator=generator).to(device) / math.prod(size)
        self.photo = torch.rand(1, 3, *size, generator=generator).to(device)
        self.moments = target_moments(self.photo)
        self._optimizers: dict[str | Backend, Adam] = {}
        with torch.no_grad():
            bins = bin_to_tiles(project(self.model(), self.camera))
        self.pairs = bins.entries.shape[0] * bins.tile_size**2 / 1e6

    @property
    def optimizer(self) -> Adam:
        """That of a fit with this backend; it changes nothing."""
        backend = self.renderer.backend
        if backend not in self._optimizers:
            groups = [{"params": [x], "name": name, "lr": 0.0} for name, x in self.model.named_parameters()]
            self._optimizers[backend] = Adam(groups, backend=backend)
        return self._optimizers[backend]

    def of(self, table: str) -> dict[str, Case]:
        """What a table compares."""
        main = {"forward, no gradient": self.forward, "forward + backward": self.both, "training step": self.train}
        if table == "left out":
            return self.savings()
        if table == "scaling":
            return {"forward + backward": self.both}
        chosen = {name: case for name, case in main.items() if table == "main" or case == self.both}
        return {
            f"{name}, by {backend}": partial(self.by, backend, case)
            for name, case in chosen.items()
            for backend in backends(self.device)
        }

    def by(self, backend: str, case: Case) -> None:
        """Run a case on a backend."""
        self.renderer.backend = backend
        case()

    def _gaussians(self) -> Gaussians:
        return self.model(backend=self.renderer.backend)

    @torch.no_grad()
    def forward(self) -> Any:
        """Render without gradient."""
        return self.renderer(self._gaussians(), self.camera).image

    def both(self, frozen: tuple[str, ...] = (), outputs: tuple[str, ...] = ("image",), **factors: Tensor) -> None:
        """Render, some of the Gaussians' tensors detached or multiplied, and go back to the model's parameters."""
        gaussians = self._gaussians()
        changes = {name: getattr(gaussians, name).detach() for name in frozen}
        changes |= {name: getattr(gaussians, name) * factor for name, factor in factors.items()}
        rendering = self.renderer(replace(gaussians, **changes), self.camera, outputs=outputs)
        picture = rendering.image if rendering.image is not None else rendering.alpha
        (picture * self.weights[:, : picture.shape[1]]).sum().backward()
        self.model.zero_grad()

    def train(self) -> None:
        """One step of training, densification left aside."""
        image = self.renderer(self._gaussians(), self.camera).image
        backend = self.renderer.backend
        photometric_loss(image.clamp(0, 1), self.photo, 0.2, moments=self.moments, backend=backend).backward()
        self.optimizer.step()
        self.optimizer.zero_grad()

    def stages(self) -> Iterator[str]:
        """A training step in its parts; says the name of each when it is done."""
        projected = project(self.model(), self.camera)
        names = ("means2d", "factors", "opacities", "colors")
        outputs = [getattr(projected, name) for name in names]
        inputs: Any = [x.detach().requires_grad_() for x in outputs]
        yield "projection, harmonics"
        composited = composite(replace(projected, **dict(zip(names, inputs, strict=True))), inputs[3]).features
        yield "compositing, binning included"
        image = composited.detach().requires_grad_()
        photometric_loss(image.clamp(0, 1), self.photo, 0.2, moments=self.moments).backward()
        yield "loss, forward + backward"
        grads = torch.autograd.grad(composited, inputs, image.grad)
        yield "compositing, backward"
        torch.autograd.backward(outputs, grads)
        yield "projection, harmonics, backward"
        self.optimizer.step()
        self.optimizer.zero_grad()
        yield "Adam"

    def savings(self) -> dict[str, Case]:
        """Forward + backward with one thing less each time."""
        half = (torch.arange(self.count, device=self.device) % 2).float()
        return {
            "everything": self.both,
            "no gradient at all": self.forward,
            "alpha only": partial(self.both, outputs=("alpha",)),
            "colours frozen": partial(self.both, PARAMETERS[4:]),
            "geometry frozen": partial(self.both, PARAMETERS[:3]),
            "all but colours frozen": partial(self.both, PARAMETERS[:4]),
            "half of the Gaussians dropped": partial(self.both, opacities=half),
            "half of the Gaussians behind the camera": partial(self.both, means=(2 * half - 1)[:, None]),
        }


def _memory_of_its_own(count: int, backend: str) -> float:
    """MiB that rendering forward and backward takes over importing, in a process that does nothing else."""
    program = f"from kgs.bench.speed import _memory; print(_memory({count}, {backend!r}))"
    return float(subprocess.run([sys.executable, "-c", program], capture_output=True, check=True).stdout)


def _memory(count: int, backend: str) -> float:
    Cases(10, (16, 16), CPU, backend).both()  # imports what it needs
    before = peak_rss_mb()
    cases = Cases(count, SIZE, CPU, backend)
    for _ in range(3):
        cases.both()
    return peak_rss_mb() - before


def _scaling(rows: list[Row], minimum: int) -> dict[str, np.ndarray]:
    """Pairs of a size and seconds, `(P, 2)`: by Gaussians and pairs at the full size, by pixels at a fixed count."""
    full = [row for row in rows if (row["height"], row["width"]) == SIZE]
    fixed = [row for row in rows if row["gaussians"] == minimum]
    points = {
        "Gaussians": [(row["gaussians"], row["wall_s"]) for row in full],
        "pairs": [(1e6 * row["pairs_millions"], row["wall_s"]) for row in full],
        "pixels": [(row["height"] * row["width"], row["wall_s"]) for row in fixed],
    }
    return {name: np.array(sorted(of)) for name, of in points.items()}


def _exponent(points: np.ndarray) -> float:
    """Slope of the line through the logarithms."""
    x, y = np.log(points).T
    return float(np.polyfit(x, y, 1)[0])


def _markdown(rows: list[Row], memory: dict[str, dict[int, float]], unit: float, exponents: dict[str, float]) -> str:
    tables: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        name = f"{row['case']}, {row['backend']}".removesuffix(", auto")
        tables.setdefault(row["table"], {}).setdefault(name, []).append(row)
    quiet = tables["main"]
    counts = [f"{row['gaussians'] // 1000}k" for row in next(iter(quiet.values()))]
    main = []
    for name, by_count in quiet.items():
        spread = ([1e3 * row[f"{of}_s"] for of in ("wall", "best", "worst")] for row in by_count)
        main.append([name, *("{:.0f} ({:.0f} to {:.0f}) ms".format(*numbers) for numbers in spread)])
        case, _, backend = name.rpartition(", ")
        if backend == "numba":
            main.append([f"{case}, times faster", *_ratios(quiet[f"{case}, torch"], by_count, case)])
    for name, by_count in tables["busy"].items():
        main.append([f"{name}, wall beside two busy processes over that", *_ratios(by_count, quiet[name], "busy")])
    for backend, peaks in memory.items():
        target = "peak memory" if backend == "numba" else ""  # torch has no target
        cells = [_with_target(mb, target, count, ".0f") for count, mb in peaks.items()]
        main.append([f"peak memory over importing, {backend}, MiB", *cells])
    stages = [[name, *(f"{row['wall_s'] * 1e3:.0f}" for row in rows)] for name, rows in tables["stages"].items()]
    savings = [row for rows in tables["left out"].values() for row in rows]
    whole = savings[0]["wall_s"]
    left_out = [[row["case"], f"{row['wall_s'] * 1e3:.0f}", f"{row['wall_s'] / whole:.2f}"] for row in savings]
    grows = ", ".join(f"{name}^{power:.2f}" for name, power in exponents.items())
    return (
        markdown_table(f"Wall clock, median (least to largest), and ratios; target; {SIZE[1]}x{SIZE[0]}", counts, main)
        + markdown_table("Parts of a training step, ms", counts, stages)
        + markdown_table(f"Left out, {savings[0]['gaussians']} Gaussians", ["ms", "of everything"], left_out)
        + f"Time grows as {grows} (pixels: at one count). Calibration: exp {unit * 1e9:.2f} ns per element.\n"
    )


def _ratios(over: list[Row], under: list[Row], name: str) -> list[str]:
    """The wall time of some rows in that of others, of the same counts."""
    pairs = zip(over, under, strict=True)
    return [_with_target(one["wall_s"] / other["wall_s"], name, one["gaussians"], ".1f") for one, other in pairs]


def _with_target(value: float, name: str, count: int, digits: str) -> str:
    """A number and its target."""
    target = TARGETS.get(name, {}).get(count)
    return f"{value:{digits}}" + ("" if target is None else f"; {target:g}")
