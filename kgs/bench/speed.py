"""Time and memory of the renderer and of a training step on this machine, and how they grow."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kgs.fit.outputs import peak_rss_mb, versions, write_json

from .cases import Cases
from .output import markdown_table, write_csv
from .timing import Times, calibrations, take_turns

__all__ = ["SIZE", "TARGETS", "measure_speed"]

SIZE = (378, 504)
# What kgs is held to on two cores, by count of Gaussians: seconds, and MiB over what importing takes.
TARGETS = {
    "forward, no gradient": {10_000: 0.030, 50_000: 0.110, 200_000: 0.250},
    "forward + backward": {10_000: 0.080, 50_000: 0.280, 200_000: 0.480},
    "training step": {10_000: 0.125, 50_000: 0.330, 200_000: 0.540},
    "peak memory": {10_000: 250.0, 50_000: 450.0, 200_000: 900.0},
}


@dataclass(frozen=True)
class Row:
    """One line of the results.

    Args:
        table: "main", "stages", "left out" or "scaling".
        case: what was done.
        count: Gaussians.
        size: height and width.
        pairs: of pixel and Gaussian in the tiles' lists, in millions.
        times: wall clock and processor time.
        target: seconds it is held to, if it is.
    """

    table: str
    case: str
    count: int
    size: tuple[int, int]
    pairs: float
    times: Times
    target: float | None = None


def measure_speed(
    out: Path, *, quick: bool = False, device: str = "cpu", say: Callable[[str], None] = print
) -> dict[str, Any]:
    """Measure, and write speed.csv, speed.json, speed.md and scaling.png.

    Args:
        out: folder for the results, made if it is not there.
        quick: fewer Gaussians and repetitions: tens of seconds instead of minutes.
        device: where to render.
        say: where lines for the user go.

    Returns:
        What speed.json holds.
    """
    out.mkdir(parents=True, exist_ok=True)
    where, repeats = torch.device(device), 3 if quick else 7
    counts = (2_000, 10_000) if quick else (10_000, 50_000, 200_000)
    rows: list[Row] = []
    memory = {}
    for count in counts:
        say(f"{count} Gaussians at {SIZE[1]}x{SIZE[0]} ...")
        cases = Cases(count, SIZE, where)
        rows += [
            Row("main", name, count, SIZE, cases.pairs, times, TARGETS[name].get(count))
            for name, times in take_turns(cases.main(), repeats, where).items()
        ]
        rows += [
            Row("stages", name, count, SIZE, cases.pairs, times)
            for name, times in take_turns(cases.stages(), repeats, where).items()
        ]
        if where.type == "cpu":
            memory[count] = _memory_of_its_own(count)
    say("what is left out ...")
    cases = Cases(counts[min(1, len(counts) - 1)], SIZE, where)
    rows += [
        Row("left out", name, cases.count, SIZE, cases.pairs, times)
        for name, times in take_turns(cases.savings(), repeats, where).items()
    ]
    say("scaling ...")
    sizes = [(SIZE[0] // k, SIZE[1] // k) for k in (3, 2, 1)]
    scaled = [(count, SIZE) for count in (counts[0] // 2, *counts)] + [(counts[0], size) for size in sizes]
    for count, size in dict.fromkeys(scaled):
        cases = Cases(count, size, where)
        times = take_turns({"forward + backward": cases.main()["forward + backward"]}, repeats, where)
        rows.append(Row("scaling", "forward + backward", count, size, cases.pairs, times["forward + backward"]))
    units = calibrations(where)
    exponents = {
        "count": _exponent([(r.count, r.times.wall) for r in rows if r.table == "scaling" and r.size == SIZE]),
        "pairs": _exponent([(r.pairs, r.times.wall) for r in rows if r.table == "scaling" and r.size == SIZE]),
        "pixels": _exponent(
            [(math.prod(r.size), r.times.wall) for r in rows if r.table == "scaling" and r.count == counts[0]]
        ),
    }
    result = {
        "rows": [asdict(row) for row in rows],
        "peak_memory_mb": memory,
        "calibrations": units,
        "exponents": exponents,
        "threads": torch.get_num_threads(),
        "device": device,
        "versions": versions(),
    }
    write_csv(out / "speed.csv", [_plain(row, units) for row in rows])
    write_json(out / "speed.json", result)
    table = _markdown(rows, memory, units, exponents)
    (out / "speed.md").write_text(table)
    _plot(out / "scaling.png", [row for row in rows if row.table == "scaling"])
    say(table)
    return result


def _memory_of_its_own(count: int) -> float:
    """MiB that rendering forward and backward takes over importing, in a process that does nothing else."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_memory, (count,))


def _memory(count: int) -> float:
    before = peak_rss_mb()
    cases = Cases(count, SIZE, torch.device("cpu"))
    for _ in range(3):
        cases.both(cases.model())
    return float(peak_rss_mb() - before)


def _exponent(points: list[tuple[float, float]]) -> float:
    """Slope of the line through the logarithms."""
    x, y = np.log(np.array(points)).T
    return float(np.polyfit(x, y, 1)[0])


def _plain(row: Row, units: dict[str, float]) -> dict[str, Any]:
    """A line of speed.csv."""
    t = row.times
    return {
        "table": row.table,
        "case": row.case,
        "gaussians": row.count,
        "height": row.size[0],
        "width": row.size[1],
        "pairs_millions": row.pairs,
        "wall_s": t.wall,
        "best_s": t.best,
        "worst_s": t.worst,
        "cpu_s": t.cpu,
        "repeats": t.repeats,
        "target_s": row.target,
        "wall_in_exp_per_pair": t.wall / (row.pairs * 1e6) / units["exp"],
    }


def _markdown(rows: list[Row], memory: dict[int, float], units: dict[str, float], exponents: dict[str, float]) -> str:
    tables: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        tables.setdefault(row.table, {}).setdefault(row.case, []).append(row)
    counts = [f"{row.count // 1000}k" for row in next(iter(tables["main"].values()))]
    main = [[name, *(_cell(row.times, row.target) for row in found)] for name, found in tables["main"].items()]
    held = TARGETS["peak memory"]
    if memory:
        cells = [f"{mb:.0f} MiB" + (f"; {held[count]:.0f}" if count in held else "") for count, mb in memory.items()]
        main.append(["peak memory over importing", *cells])
    stages = [[name, *(f"{row.times.wall * 1e3:.0f}" for row in found)] for name, found in tables["stages"].items()]
    savings = [row for found in tables["left out"].values() for row in found]
    everything = savings[0].times.wall
    left_out = [[row.case, f"{row.times.wall * 1e3:.0f}", f"{row.times.wall / everything:.2f}"] for row in savings]
    size = f"{SIZE[1]}x{SIZE[0]}, harmonics of degree 3"
    return (
        markdown_table(f"{size}: wall clock, median (least to largest); what it is held to", counts, main)
        + markdown_table("Parts of a training step, ms", counts, stages)
        + markdown_table(
            f"What is not asked for is not computed, {savings[0].count} Gaussians, forward + backward",
            ["ms", "of everything"],
            left_out,
        )
        + f"Time grows as count^{exponents['count']:.2f}, pairs^{exponents['pairs']:.2f}, "
        f"pixels^{exponents['pixels']:.2f} (at a fixed count).\n"
        f"Calibration: exp {units['exp'] * 1e9:.2f} ns an element, dense oracle (400 Gaussians, 48x64) "
        f"{units['dense'] * 1e3:.0f} ms.\n"
    )


def _cell(times: Times, target: float | None) -> str:
    text = f"{times.wall * 1e3:.0f} ({times.best * 1e3:.0f} to {times.worst * 1e3:.0f}) ms"
    return text if target is None else f"{text}; {target * 1e3:.0f}"


def _plot(path: Path, rows: list[Row]) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    fewest = min(row.count for row in rows if row.size != SIZE)
    panels: dict[str, list[tuple[float, float]]] = {
        "Gaussians": [(row.count, row.times.wall) for row in rows if row.size == SIZE],
        f"pixels, {fewest} Gaussians": [(math.prod(row.size), row.times.wall) for row in rows if row.count == fewest],
        "evaluated pairs [million]": [(row.pairs, row.times.wall) for row in rows],
    }
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for axis, (label, points) in zip(axes, panels.items(), strict=True):
        x, y = np.array(sorted(points)).T
        axis.loglog(x, y, "o" if label.startswith("evaluated") else "o-", markersize=4)
        axis.set_xlabel(label)
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("forward + backward [s]")
    figure.savefig(path, dpi=120)
