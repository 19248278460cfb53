"""The plots of the study: one colour and marker per method in all of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from .presets import FAMILIES, FIXED, MAIN, OFF, PAPER
from .tables import KEYS, difference, main_cells

__all__ = ["STYLES", "write_plots"]

# Colours of Okabe and Ito, told apart by colour-blind people too; those that share one differ in the marker.
STYLES = {OFF: ("#000000", "o"), PAPER: ("#0072B2", "s"), FIXED: ("#D55E00", "^")}
for _colour, _names in zip(("#E69F00", "#CC79A7", "#009E73"), FAMILIES.values(), strict=True):
    STYLES = {**{name: (_colour, marker) for name, marker in zip(_names, "vD^p*<>", strict=False)}, **STYLES}
# How a start fills its markers.
_FILLS = dict(zip(("dense", "sift", "random", "model-points", "full-model", "scene"),
                  ("full", "none", "left", "bottom", "top", "right"), strict=True))  # fmt: skip
DPI = 110


def write_plots(frame: pd.DataFrame, out: Path) -> dict[str, str]:
    """Write a PNG for each plot that has something to show; return its caption by its name."""
    main = main_cells(frame)
    all_starts = frame.merge(main[KEYS[:2]].drop_duplicates())
    frames = {
        "cost.png": (all_starts.assign(x=all_starts.cpu_seconds), "CPU time of the fit [s]"),
        "coadaptation.png": (all_starts.assign(x=1e3 * all_starts.coadaptation), "co-adaptation [1e-3]"),
        "gap.png": (all_starts.assign(x=all_starts["train.psnr"] - all_starts["test.psnr"]), "training less test [dB]"),
    }
    one_each = "one point per cell, each start with its filling"
    main = main[main.method.isin(MAIN)]
    rates = main[main.method.isin((OFF, PAPER)) & main["thresholds.over"].notna()]
    distance = "distance [median of the first points]"
    written = {
        "Paired differences of test PSNR over off, with 95 % intervals; n pairs": ("forest.png", _forest(frame, out)),
        f"Test PSNR during the fit, {', '.join(MAIN)}: mean over seeds, band of one sd": (
            "curves.png",
            _panels(main[main.curve.str.len() > 0], out / "curves.png", _curve, "step", "test PSNR [dB]"),
        ),
        **{
            f"Test PSNR against {what}: {one_each}": (
                name, _panels(cells.dropna(subset=["x", "test.psnr"]), out / name, _scatter, label, "test PSNR [dB]")
            )
            for what, (name, (cells, label)) in zip(
                ("CPU time", "co-adaptation, the variance of random halves' renders",
                 "overfitting, the PSNR of training views less that of test views"), frames.items(), strict=True)
        },
        "Gaussians whose mean gradient is over the densification threshold, by distance from the nearest camera, "
        f"{OFF} and {PAPER}: mean over seeds, bars of one sd; each bin began with a sixth of the first points; a fit at "
        "its limit of Gaussians keeps those that it could not densify": (
            "thresholds.png", _panels(rates, out / "thresholds.png", _thresholds, distance, "over the threshold [%]")
        ),
    }  # fmt: skip
    return {name: caption for caption, (name, is_there) in written.items() if is_there}


def _forest(frame: pd.DataFrame, out: Path) -> bool:
    """Every difference over off: first the means over the scenes' main settings, then each setting's own."""
    groups = {"mean over scenes": main_cells(frame)} | {
        "{}, {} views, {}".format(*setting): cells for setting, cells in frame.groupby(KEYS[:3], sort=False)
    }
    lines: list[tuple[str, Any]] = []
    for where, cells in groups.items():
        found = []
        for method in [name for name in STYLES if name != OFF and (cells.method == name).any()]:
            gain = difference(cells, method=(method, OFF))
            several = cells[cells.method == method].scene.nunique() > 1
            found += [(method, gain)] if gain.pairs and (several or where != "mean over scenes") else []
        lines += [(where, None), *found] if found else []
    if not lines:
        return False
    figure = _figure(7.5, 0.9 + 0.22 * len(lines))
    axis = figure.subplots()
    labels = [name if gain is None else f"{name} (n = {gain.pairs})" for name, gain in lines]
    axis.set_yticks(range(len(lines)), labels, fontsize=8)
    for level, (name, gain) in enumerate(lines):
        if gain is None:
            axis.get_yticklabels()[level].set_fontweight("bold")
            continue
        colour, marker = STYLES[name]
        axis.plot([gain.low, gain.high], [level, level], color=colour, linewidth=1.5)
        axis.plot(gain.mean, level, marker, color=colour, markersize=5)
    axis.axvline(0, color="#777777", linewidth=1)
    axis.set_ylim(len(lines) - 0.5, -0.5)
    axis.set_xlabel("test PSNR over off, same first points and views [dB]")
    axis.grid(axis="x", alpha=0.3)
    figure.savefig(out / "forest.png")
    return True


def _curve(axis: Any, cells: pd.DataFrame, style: dict[str, Any]) -> None:
    curves = [{point["step"]: point["test_psnr"] for point in curve} for curve in cells.curve]
    values = pd.DataFrame(curves, dtype=float).T.sort_index().dropna()
    mean, spread = values.mean(axis=1), values.std(axis=1).fillna(0)
    axis.plot(values.index, mean, markersize=4, **style)
    axis.fill_between(values.index, mean - spread, mean + spread, color=style["color"], alpha=0.15, lw=0)


def _thresholds(axis: Any, cells: pd.DataFrame, style: dict[str, Any]) -> None:
    over, counts = (np.array(cells[f"thresholds.{key}"].tolist(), float) for key in ("over", "gaussians"))
    shares = pd.DataFrame(100 * over / np.where(counts > 0, counts, np.nan)).dropna(axis=1, how="all")
    places = shares.columns + 0.46 + 0.08 * (style["label"] == PAPER)
    axis.errorbar(places, shares.mean(), shares.std().fillna(0), markersize=4, capsize=2, **style)
    edges = np.array(cells["thresholds.distance"].tolist()).mean(0)
    axis.set_xticks(range(len(edges)), [f"{edge:.2g}" for edge in edges])
    axis.set_ylim(bottom=0)


def _scatter(axis: Any, cells: pd.DataFrame, style: dict[str, Any]) -> None:
    for start, some in cells.groupby("start", sort=False):
        fill = {"fillstyle": _FILLS.get(start, "none"), "markersize": 5, "alpha": 0.85, "linestyle": ""}
        axis.plot(some.x, some["test.psnr"], **style | fill)
        axis.plot([], [], "h", color="grey", fillstyle=fill["fillstyle"], label=f"from {start}")


def _panels(
    frame: pd.DataFrame, path: Path, draw: Callable[[Any, pd.DataFrame, dict[str, Any]], None], x: str, y: str
) -> bool:
    """One panel per scene and number of views, two in a row, and one legend for all; False of no cells."""
    if frame.empty:
        return False
    settings = list(frame.groupby(KEYS[:2], sort=False))
    columns, rows = min(2, len(settings)), math.ceil(len(settings) / 2)
    figure = _figure(3.9 * columns + 0.4, 3.2 * rows + 0.5)
    axes = figure.subplots(rows, columns, squeeze=False).flat
    for ((scene, views), cells), axis in zip(settings, axes, strict=False):
        for method, some in cells.groupby("method", sort=False):
            colour, marker = STYLES.get(method, ("#777777", "x"))
            draw(axis, some, {"color": colour, "marker": marker, "label": method})
        counts = sorted({cells.groupby(KEYS).size().min(), cells.groupby(KEYS).size().max()})
        axis.set_title(f"{scene}, {views} views, n = {' to '.join(map(str, counts))}", fontsize=9)
        axis.set_xlabel(x)
        axis.set_ylabel(y)
        axis.grid(alpha=0.3)
    for axis in axes:
        axis.remove()
    handles = [handle for axis in figure.axes for handle in zip(*axis.get_legend_handles_labels(), strict=True)]
    found = {label: handle for handle, label in sorted(handles, key=lambda pair: pair[1].startswith("from "))}
    figure.legend(found.values(), found.keys(), loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    figure.savefig(path)
    return True


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    return Figure(figsize=(width, height), dpi=DPI, layout=ConstrainedLayoutEngine(wspace=0.08, hspace=0.08))
