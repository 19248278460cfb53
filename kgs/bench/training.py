"""Held-out quality against training time: one knob of the fit at a time, around the default."""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from kgs.fit.config import FAST, FitConfig
from kgs.fit.outputs import versions

from .grid import run_grid
from .output import markdown_table, write_csv
from .scenes import SYNTHETIC, check_scenes

__all__ = ["KNOBS", "fit_cell", "measure_training", "training_cells"]

# The default of each stands in FitConfig; where None means the rule there, it is the default here too.
KNOBS: dict[str, tuple[Any, ...]] = {
    "steps": (500, 1000),
    "coarse": (0.5,),
    "growth": (0.8,),
    "sh_degree": (0, 1),
    "max_gaussians": (5_000, 10_000),
    "drop": (0.0, 0.1, 0.3),
}
# What the table shows, and with how many decimals.
_DECIMALS = {"psnr": 2, "gain": 2, "ssim": 3, "train_psnr": 1, "cpu_seconds": 0, "gaussians": 0}
SIZE = (126, 168)  # of the synthetic pictures


def training_cells(scenes: list[str], seeds: int) -> list[dict[str, Any]]:
    """The cells of the grid: the default, `--fast`, and each other value of each knob, on each scene with each seed."""
    settings: list[dict[str, Any]] = [{}, {"fast": True}]
    settings += [{knob: value} for knob, values in KNOBS.items() for value in values]
    return [
        {"scene": scene, "seed": seed, **setting} for seed in range(seeds) for setting in settings for scene in scenes
    ]


def fit_cell(cell: dict[str, Any]) -> dict[str, Any]:
    """One fit.

    Args:
        cell: `scene`, "synthetic" or "fern" (found through KGS_DATA); `fast` where the fit starts from that setting and
            not from the default; the rest are fields of FitConfig. The fit begins with SIFT points unless "init" says
            otherwise.
    """
    from kgs.datasets import load_scene, synthetic_scene
    from kgs.fit.run import choose_points, measure
    from kgs.fit.trainer import Trainer

    settings = FAST if cell.get("fast") else FitConfig()
    turned = {key: value for key, value in cell.items() if key not in ("scene", "fast")}
    config = FitConfig.from_dict(settings.to_dict() | {"init": "sift"} | turned)
    if cell["scene"] == SYNTHETIC:
        scene = synthetic_scene(train_views=3, size=SIZE, seed=cell["seed"])
    else:
        scene = load_scene(Path(os.environ["KGS_DATA"]) / "llff" / cell["scene"], train_views=3, downscale=2)
    trainer = Trainer(scene, config, choose_points(scene, config))
    start = time.process_time()
    trainer.fit()
    cpu_seconds = time.process_time() - start
    metrics = measure(trainer)
    return {
        "psnr": metrics["test"]["psnr"],
        "ssim": metrics["test"]["ssim"],
        "train_psnr": metrics["train"]["psnr"],
        "seconds": trainer.seconds,
        "cpu_seconds": cpu_seconds,
        "gaussians": len(trainer.model),
        "curve": trainer.curve,
        "versions": versions(),
    }


def measure_training(
    out: Path, *, quick: bool = False, processes: int | None = None, say: Callable[[str], None] = print
) -> list[dict[str, Any]]:
    """Run the grid or go on with it, and write training.jsonl, training.csv, training.md and training.png.

    Args:
        out: folder for the results; cells that its training.jsonl has are not repeated.
        quick: two tiny cells, to see that it works.
        processes: fits at a time, None for one a core; the seconds of a fit hold for that many at a time.
        say: where lines for the user go.

    Returns:
        The lines of training.jsonl.
    """
    scenes = [SYNTHETIC]
    if "KGS_DATA" in os.environ:
        check_scenes(Path(os.environ["KGS_DATA"]), ["llff/fern"])
        scenes.append("fern")
    else:
        say("KGS_DATA is not set: the synthetic scene alone, without fern")
    cells = training_cells(scenes, seeds=3)
    if quick:
        cells = [{"scene": SYNTHETIC, "seed": 0, "steps": steps, "max_gaussians": 1000} for steps in (20, 40)]
    processes = processes or os.cpu_count() or 1
    rows = run_grid(cells, fit_cell, out / "training.jsonl", processes=processes, say=say)
    summary = summarize(rows)
    table = _markdown(summary)
    (out / "training.md").write_text(table, encoding="utf-8")
    write_csv(out / "training.csv", summary)
    _plot(out / "training.png", summary)
    say(table)
    return rows


def summarize(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Every setting of every scene: mean and standard deviation over seeds, and of the gain over the default.

    The gain is in dB of test PSNR, from the seeds that both have; the two fits of a seed have the same first points.
    """
    groups: dict[tuple[str, str, Any], dict[int, dict[str, Any]]] = {}
    for row in rows:
        knobs = {key: value for key, value in row["cell"].items() if key not in ("scene", "seed")}
        knob, value = next(iter(knobs.items()), ("default", None))
        groups.setdefault((row["cell"]["scene"], knob, value), {})[row["cell"]["seed"]] = row["result"]
    summary = []
    for (scene, knob, value), results in groups.items():
        entry: dict[str, Any] = {"scene": scene, "knob": knob, "value": value, "n": len(results)}
        columns = {name: [result[name] for result in results.values()] for name in _DECIMALS if name != "gain"}
        default = groups.get((scene, "default", None), {})
        columns["gain"] = [results[seed]["psnr"] - default[seed]["psnr"] for seed in results.keys() & default.keys()]
        for name, values in columns.items():
            entry[name] = statistics.mean(values) if values else math.nan
            entry[f"{name}_sd"] = statistics.stdev(values) if len(values) > 1 else math.nan
        summary.append(entry)
    return summary


def _markdown(summary: list[dict[str, Any]]) -> str:
    heads = ("PSNR [dB]", "over the default", "SSIM", "PSNR of training views", "CPU seconds", "Gaussians")
    rows = []
    for entry in sorted(summary, key=lambda e: (e["scene"], e["knob"] != "default", e["knob"])):
        spread = [f"{entry[name]:.{d}f} ({entry[f'{name}_sd']:.{d}f})" for name, d in _DECIMALS.items()]
        is_flag = entry["value"] is None or entry["value"] is True
        setting = entry["knob"] if is_flag else f"{entry['knob']} {entry['value']}"
        rows.append([entry["scene"], setting, entry["n"], *spread])
    return markdown_table(
        "Test views and CPU seconds of the fit, mean (standard deviation over n seeds)",
        ("setting", "n", *heads),
        rows,
        first="scene",
    )


def _plot(path: Path, summary: list[dict[str, Any]]) -> None:
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(entry["scene"] for entry in summary))
    figure = Figure(figsize=(5.5 * len(scenes), 4), layout="constrained")
    axes = figure.subplots(1, len(scenes), squeeze=False)
    for axis, scene in zip(axes[0], scenes, strict=True):
        entries = [entry for entry in summary if entry["scene"] == scene]
        default = [entry for entry in entries if entry["knob"] == "default"]
        for k, knob in enumerate(dict.fromkeys(e["knob"] for e in entries if e["knob"] != "default")):
            line = sorted([e for e in entries if e["knob"] == knob] + default, key=lambda e: e["cpu_seconds"])
            x, y, error = (np.array([e[key] for e in line]) for key in ("cpu_seconds", "psnr", "psnr_sd"))
            axis.errorbar(x, y, error, color=f"C{k}", marker="o", markersize=4, capsize=2, linewidth=1, label=knob)
        for entry in default:
            axis.plot(entry["cpu_seconds"], entry["psnr"], "k*", markersize=12, label="default")
        axis.set_xscale("log")
        axis.set_title(scene)
        axis.set_xlabel("CPU seconds of the fit")
        axis.set_ylabel("test PSNR [dB]")
        axis.grid(alpha=0.3, which="both")
        axis.legend(frameon=False)
    figure.savefig(path, dpi=120)
