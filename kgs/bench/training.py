"""Held-out quality against training time: one knob of the fit at a time, around the default."""

from __future__ import annotations

import os
import statistics
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from kgs.errors import DataError
from kgs.fit.config import FitConfig
from kgs.fit.report import versions

from .grid import run_grid

__all__ = ["KNOBS", "fit_cell", "measure_training", "training_cells"]

# The default of each stands in FitConfig; where None means the rule there, it is the default here too.
KNOBS: dict[str, tuple[Any, ...]] = {
    "steps": (500, 1000),
    "sh_degree": (0, 1, 2),
    "max_gaussians": (2_500, 5_000, 10_000),
    "drop": (0.0, 0.1, 0.3),
}
SYNTHETIC = "synthetic"
SIZE = (126, 168)  # of the synthetic pictures


def training_cells(scenes: list[str], seeds: int) -> list[dict[str, Any]]:
    """The cells of the grid: the default and each other value of each knob, on each scene with each seed."""
    settings: list[dict[str, Any]] = [{}]
    settings += [{knob: value} for knob, values in KNOBS.items() for value in values]
    return [
        {"scene": scene, "seed": seed, **setting} for seed in range(seeds) for setting in settings for scene in scenes
    ]


def fit_cell(cell: dict[str, Any]) -> dict[str, Any]:
    """One fit: `scene` is "synthetic" or "fern" (found through KGS_DATA); what else the cell has goes to FitConfig."""
    from kgs.datasets import load_scene, synthetic_scene
    from kgs.fit.run import choose_points, measure
    from kgs.fit.trainer import Trainer

    settings = {key: value for key, value in cell.items() if key != "scene"}
    unknown = settings.keys() - {field.name for field in fields(FitConfig)}
    if unknown:
        raise ValueError(f"cell: expected fields of FitConfig, got {sorted(unknown)}")
    if cell["scene"] == SYNTHETIC:
        scene = synthetic_scene(train_views=3, size=SIZE, seed=cell["seed"])
    else:
        scene = load_scene(Path(os.environ["KGS_DATA"]) / "llff" / cell["scene"], train_views=3, downscale=2)
    config = FitConfig(**settings)
    trainer = Trainer(scene, config, choose_points(scene, config))
    trainer.fit()
    metrics = measure(trainer)
    return {
        "psnr": metrics["test"]["psnr"],
        "ssim": metrics["test"]["ssim"],
        "train_psnr": metrics["train"]["psnr"],
        "seconds": trainer.seconds,
        "gaussians": len(trainer.model),
        "curve": trainer.curve,
        "versions": versions(),
    }


def measure_training(
    out: Path, *, quick: bool = False, processes: int | None = None, say: Callable[[str], None] = print
) -> list[dict[str, Any]]:
    """Run the grid or go on with it, and write training.jsonl, training.md and training.png.

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
        if not (Path(os.environ["KGS_DATA"]) / "llff" / "fern").is_dir():
            raise DataError(Path(os.environ["KGS_DATA"]), "llff/fern", "expected this scene in the folder of KGS_DATA")
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
    _plot(out / "training.png", summary)
    say(table)
    return rows


def summarize(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean and standard deviation over seeds of every setting of every scene."""
    groups: dict[tuple[str, str, Any], list[dict[str, Any]]] = {}
    for row in rows:
        knobs = {key: value for key, value in row["cell"].items() if key not in ("scene", "seed")}
        knob, value = next(iter(knobs.items()), ("default", None))
        groups.setdefault((row["cell"]["scene"], knob, value), []).append(row["result"])
    summary = []
    for (scene, knob, value), results in groups.items():
        entry: dict[str, Any] = {"scene": scene, "knob": knob, "value": value, "n": len(results)}
        for name in ("psnr", "ssim", "train_psnr", "seconds", "gaussians"):
            values = [result[name] for result in results]
            entry[name] = statistics.mean(values)
            entry[f"{name}_sd"] = statistics.stdev(values) if len(values) > 1 else 0.0
        summary.append(entry)
    return summary


def _markdown(summary: list[dict[str, Any]]) -> str:
    lines = [
        "Test views, mean (standard deviation over n seeds); seconds of training",
        "",
        "| scene | setting | n | PSNR [dB] | SSIM | PSNR of training views | seconds | Gaussians |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for entry in sorted(summary, key=lambda e: (e["scene"], e["knob"] != "default", e["knob"])):
        setting = entry["knob"] if entry["value"] is None else f"{entry['knob']} {entry['value']}"
        lines.append(
            f"| {entry['scene']} | {setting} | {entry['n']} | {entry['psnr']:.2f} ({entry['psnr_sd']:.2f}) "
            f"| {entry['ssim']:.3f} ({entry['ssim_sd']:.3f}) | {entry['train_psnr']:.1f} "
            f"| {entry['seconds']:.0f} ({entry['seconds_sd']:.0f}) | {entry['gaussians']:.0f} |"
        )
    return "\n".join([*lines, ""])


def _plot(path: Path, summary: list[dict[str, Any]]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes = list(dict.fromkeys(entry["scene"] for entry in summary))
    figure, axes = pyplot.subplots(1, len(scenes), figsize=(5.5 * len(scenes), 4), squeeze=False, layout="constrained")
    for axis, scene in zip(axes[0], scenes, strict=True):
        entries = [entry for entry in summary if entry["scene"] == scene]
        default = [entry for entry in entries if entry["knob"] == "default"]
        for k, knob in enumerate(dict.fromkeys(e["knob"] for e in entries if e["knob"] != "default")):
            line = sorted([e for e in entries if e["knob"] == knob] + default, key=lambda e: e["seconds"])
            x, y, error = (np.array([e[key] for e in line]) for key in ("seconds", "psnr", "psnr_sd"))
            axis.errorbar(x, y, error, color=f"C{k}", marker="o", markersize=4, capsize=2, linewidth=1, label=knob)
        for entry in default:
            axis.plot(entry["seconds"], entry["psnr"], "k*", markersize=12, label="default")
        axis.set_xscale("log")
        axis.set_title(scene)
        axis.set_xlabel("seconds of training")
        axis.set_ylabel("test PSNR [dB]")
        axis.grid(alpha=0.3, which="both")
        axis.legend(frameon=False)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
