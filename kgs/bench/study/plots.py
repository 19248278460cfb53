"""The plots of the study: one colour and marker per method in all of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from .presets import FAMILIES, FIXED, MAIN, OFF, PAPER
from .tables import KEYS, STARTS, difference, each, main_cells

__all__ = ["STYLES", "write_plots"]

# Colours of Okabe and Ito, told apart by colour-blind people too; those that share one differ in the marker.
STYLES = {OFF: ("#000000", "o"), PAPER: ("#0072B2", "s"), FIXED: ("#D55E00", "^")}
for _colour, _names in zip(("#E69F00", "#CC79A7", "#009E73"), FAMILIES.values(), strict=True):
    STYLES = {**{name: (_colour, marker) for name, marker in zip(_names, "vD^p*<>", strict=False)}, **STYLES}
_FILLS = dict(zip(STARTS, ("none", "left", "bottom", "top", "full", "right"), strict=True))  # of a start's markers
_OTHER = ("#777777", "x")
DPI = 110
Draw = Callable[[Any, pd.DataFrame, dict[str, Any]], None]


def write_plots(frame: pd.DataFrame, out: Path) -> dict[str, str]:
    """Write a PNG for each plot that has something to show; return the captions by name."""
    points = main_cells(frame, STARTS)
    points = points.assign(cost=points.cpu_seconds, coadaptation=1e3 * points.coadaptation)
    points["gap"] = points["train.psnr"] - points["test.psnr"]
    main = main_cells(frame[frame.method.isin(MAIN)])
    rates = main[(main.method != FIXED) & main["thresholds.over"].notna()]
    psnr, axes = "test PSNR [dB]", {"cost": "CPU time of the fit [s]", "coadaptation": "co-adaptation [1e-3]"}
    axes["gap"] = "overfitting: PSNR of training views less that of test views [dB]"
    captions = {"forest": "Paired differences of test PSNR over off, with 95 % intervals; n pairs"}
    captions["curves"] = f"Test PSNR during the fit, {', '.join(MAIN)}: mean over seeds, band of one sd"
    captions |= {n: f"Test PSNR against {x}; one point per cell, filled by its start" for n, x in axes.items()}
    captions["thresholds"] = (
        "Gaussians whose mean gradient is over the densification threshold, by distance from the nearest camera, "
        f"{OFF} and {PAPER}: mean over seeds, bars of one sd; each bin began with a sixth of the first points; a fit "
        "at its limit of Gaussians keeps those that it could not densify"
    )
    figures = {"forest": _forest(frame), "curves": _panels(main[main.curve.str.len() > 0], _curve, "step", psnr)}
    for name, label in axes.items():
        cells = points.assign(x=points[name]).dropna(subset=["x", "test.psnr"])
        figures[name] = _panels(cells, _scatter, label, psnr)
    distance = "distance [median of the first points]"
    figures["thresholds"] = _panels(rates, _thresholds, distance, "over the threshold [%]")
    written = {name: figure for name, figure in figures.items() if figure is not None}
    for name, figure in written.items():
        figure.savefig(out / f"{name}.png")
    return {f"{name}.png": captions[name] for name in written}


def _forest(frame: pd.DataFrame) -> Any:
    """Every difference over off: first the means over the scenes' main settings, then each setting's own."""
    main = main_cells(frame)
    groups = {"mean over scenes": main[main.groupby("method").scene.transform("nunique") > 1]}
    groups |= {"{}, {} views, {}".format(*setting): cells for setting, cells in each(frame, *KEYS[:3])}
    lines = []
    for where, cells in groups.items():
        gains = {method: difference(cells, "method", method, OFF) for method in cells.method.unique()}
        lines += [
            (f"{where}: {method} (n = {gain.pairs})", method, gain) for method, gain in gains.items() if gain.pairs
        ]
    if not lines:
        return None
    figure = _figure(9, 0.9 + 0.2 * len(lines))
    axis = figure.subplots()
    axis.set_yticks(range(len(lines)), [label for label, _, _ in lines], fontsize=8)
    for level, (_, method, gain) in enumerate(lines):
        colour, marker = STYLES.get(method, _OTHER)
        axis.plot([gain.low, gain.high], [level, level], color=colour, linewidth=1.5)
        axis.plot(gain.mean, level, marker, color=colour, markersize=5)
    axis.axvline(0, color="#777777", linewidth=1)
    axis.set(ylim=(len(lines) - 0.5, -0.5), xlabel="test PSNR over off, same first points and views [dB]")
    axis.grid(axis="x", alpha=0.3)
    return figure


def _curve(axis: Any, cells: pd.DataFrame, style: dict[str, Any]) -> None:
    curves = [{point["step"]: point["test_psnr"] for point in curve} for curve in cells.curve]
    values = pd.DataFrame(curves, dtype=float).T.sort_index().dropna()
    mean, spread = values.mean(axis=1), values.std(axis=1).fillna(0)
    axis.plot(values.index, mean, markersize=4, **style)
    axis.fill_between(values.index, mean - spread, mean + spread, color=style["color"], alpha=0.15, lw=0)


def _thresholds(axis: Any, cells: pd.DataFrame, style: dict[str, Any]) -> None:
    over, counts, edges = (
        np.array(cells[f"thresholds.{key}"].tolist(), float) for key in ("over", "gaussians", "distance")
    )
    shares = pd.DataFrame(100 * over / np.where(counts > 0, counts, np.nan))
    places = np.arange(over.shape[1]) + 0.46 + 0.08 * (style["label"] == PAPER)
    axis.errorbar(places, shares.mean(), shares.std().fillna(0), markersize=4, capsize=2, **style)
    axis.set_xticks(range(edges.shape[1]), [f"{edge:.2g}" for edge in edges.mean(0)])
    axis.set_ylim(bottom=0)


def _scatter(axis: Any, cells: pd.DataFrame, style: dict[str, Any]) -> None:
    for (start,), some in each(cells, "start"):
        fill = {"fillstyle": _FILLS.get(start, "none"), "markersize": 5, "alpha": 0.85, "linestyle": ""}
        axis.plot(some.x, some["test.psnr"], **style | fill)
        axis.plot([], [], "h", color="grey", fillstyle=fill["fillstyle"], label=f"from {start}")


def _panels(frame: pd.DataFrame, draw: Draw, x: str, y: str) -> Any:
    """One panel per scene and number of views, two in a row, and one legend for all; None of no cells."""
    if frame.empty:
        return None
    settings = list(each(frame, "scene", "views"))
    columns, rows = min(2, len(settings)), math.ceil(len(settings) / 2)
    figure = _figure(3.9 * columns + 0.4, 3.2 * rows + 0.5)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    found: dict[str, Any] = {}
    for axis, ((scene, views), cells) in zip(axes[: len(settings)], settings, strict=True):
        for (method,), some in each(cells, "method"):
            colour, marker = STYLES.get(method, _OTHER)
            draw(axis, some, {"color": colour, "marker": marker, "label": method})
        counts = cells.groupby(list(KEYS)).size().agg(["min", "max"]).unique()
        title = f"{scene}, {views} views, n = {' to '.join(map(str, counts))}"
        axis.set(xlabel=x, ylabel=y)
        axis.set_title(title, fontsize=9)
        axis.grid(alpha=0.3)
        found |= {label: handle for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    for axis in axes[len(settings) :]:
        axis.remove()
    labels = sorted(found, key=lambda label: label.startswith("from "))
    figure.legend(
        [found[label] for label in labels], labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8
    )
    return figure


def _figure(width: float, height: float) -> Any:
    return Figure(figsize=(width, height), dpi=DPI, layout=ConstrainedLayoutEngine(wspace=0.08, hspace=0.08))
