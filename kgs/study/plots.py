"""The plots of the study and of the training sweep: one function draws them all, one colour and marker per method."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from kgs.app.files.figures import DEFAULT, WITHOUT

from .pairs import KEYS, PSNR, STARTS, difference, grouped, main_cells, with_measures
from .presets import AUTO, FAMILIES, FIXED, MAIN, OFF, PAPER

# Colours of Okabe and Ito, told apart by colour-blind people too; those that share one differ in the marker.
STYLES = {OFF: (WITHOUT, "o"), PAPER: ("#0072B2", "s"), FIXED: ("#D55E00", "^")}
for _color, _names in zip((DEFAULT, "#E69F00", "#F0E442", "#009E73"), FAMILIES.values(), strict=True):
    STYLES = {**{name: (_color, marker) for name, marker in zip(_names, "vD^p*<>", strict=False)}, **STYLES}
_FILLS = dict(zip(STARTS, ("none", "left", "bottom", "full", "right"), strict=True))  # of a start's markers
DPI = 110


def panels(points: pd.DataFrame, styles: dict[str, tuple[str, str]] = STYLES, **axes: Any) -> Figure:
    """One panel per value of the column "panel", two in a row, with these settings of Axes.set; one legend for all.

    `points` has "panel", "label", "x", "y", and where they are known "dx" and "dy" (half the length of a bar), "start"
    (fills the markers; without it a line joins them), and "name" (stands at the y axis).
    """
    styles = {label: (f"C{k}", ".") for k, label in enumerate(points.label.unique())} | styles
    count = points.panel.nunique()
    scattered = "start" in points
    named = "name" in points
    columns = min(2, count)
    rows = -(-count // 2)
    size = (9, 0.9 + 0.2 * len(points)) if named else (3.9 * columns + 0.4, 3.2 * rows + 0.5)
    figure = Figure(size, dpi=DPI, layout="constrained")
    legend = dict[str, Any]()
    for number, ((title,), some) in enumerate(grouped(points, "panel"), 1):
        axis = figure.add_subplot(rows, columns, number)
        for (label, start), part in grouped(some.assign(start=some.get("start", "")), "label", "start"):
            color, marker = styles[label]
            look: dict[str, Any] = {"marker": marker, "ls": "" if scattered or named else "-", "alpha": 0.85, "ms": 5}
            fill = _FILLS.get(start, "none" if scattered else "full")
            bars = axis.errorbar(part.x, part.y, part.get("dy"), part.get("dx"), c=color, fillstyle=fill, **look)
            legend.setdefault(label, bars)
            if scattered:
                legend[f"from {start}"] = axis.plot([], [], "h", color="grey", fillstyle=fill)[0]
        axis.set_title(title, fontsize=9)
        axis.set(**axes)
        if axis.get_xscale() == "log":
            axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.xaxis.set(major_formatter="{x:g}", minor_formatter="")
        axis.grid(alpha=0.3)
        if named:
            axis.set_yticks(some.y, some.name, fontsize=8)
            axis.set_ylim(len(some) - 0.5, -0.5)
            axis.axvline(0, color="#777777", linewidth=1)
    if not named:
        legend = dict(sorted(legend.items(), key=lambda item: item[0].startswith("from ")))
        figure.legend([*legend.values()], [*legend], loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def write_plots(frame: pd.DataFrame, out: Path) -> dict[str, str]:
    """Write a PNG for each plot that has something to show; return the captions by file name."""
    captions = {}
    for name, (points_of, xlabel, ylabel, caption) in _PLOTS.items():
        points = points_of(frame)
        if len(points):
            scale = "log" if name == "thresholds" else "linear"
            panels(points, xlabel=xlabel, ylabel=ylabel, xscale=scale).savefig(out / f"{name}.png")
            captions[f"{name}.png"] = caption.format(xlabel)
    return captions


def _forest(frame: pd.DataFrame) -> pd.DataFrame:
    main = main_cells(frame)
    several = main[main.groupby("method").scene.transform("nunique") > 1]
    groups = {f"mean, interval over {what}": several for what in ("scenes", "seeds")}
    groups |= {"{}, {} views, {}".format(*setting): cells for setting, cells in grouped(frame, *KEYS[:3])}
    lines = []
    for where, cells in groups.items():
        for method in cells.method.unique():
            gain = difference(cells, "method", method, OFF)
            if gain.pairs:
                high = gain.over_scenes[1] if where.endswith("scenes") else gain.high
                name = f"{where}: {method} (n = {gain.pairs})"
                lines.append({"label": method, "name": name, "x": gain.mean, "dx": high - gain.mean})
    return pd.DataFrame(lines).assign(panel="", y=range(len(lines)))


def _scattered(measure: str) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """The points of test PSNR over a measure."""

    def points(frame: pd.DataFrame) -> pd.DataFrame:
        cells = with_measures(main_cells(frame, STARTS))
        return _in_panels(cells.assign(x=cells[measure], y=cells[PSNR]).dropna(subset=["x", "y"]))

    return points


def _curves(frame: pd.DataFrame) -> pd.DataFrame:
    cells = main_cells(frame)[lambda main: main.method.isin((*MAIN, AUTO)) & (main.curve.str.len() > 0)]
    steps = cells.curve.map(lambda curve: [point["step"] for point in curve])
    psnr = cells.curve.map(lambda curve: [point["test_psnr"] for point in curve])
    return _over_seeds(cells.assign(bin=steps, x=steps, y=psnr))


def _thresholds(frame: pd.DataFrame) -> pd.DataFrame:
    cells = main_cells(frame)[lambda main: main.method.isin((OFF, PAPER)) & main["thresholds.over"].notna()]
    over = cells["thresholds.over"].map(np.array)
    counts = cells["thresholds.gaussians"].map(np.array)
    edges = cells["thresholds.distance"].map(np.array)
    shares = 100 * over / counts.map(lambda count: np.where(count > 0, count, np.nan))
    middle = edges.map(lambda edge: (edge[1:] + edge[:-1]) / 2)
    return _over_seeds(cells.assign(bin=counts.map(lambda count: range(len(count))), x=middle, y=shares))


def _over_seeds(cells: pd.DataFrame) -> pd.DataFrame:
    """Mean and standard deviation over the seeds, of cells with lists of "bin", "x" and "y"; each bin has one x."""
    points = _in_panels(cells).explode(["bin", "x", "y"]).astype({"x": float, "y": float})
    points["x"] = points.groupby(["panel", "bin"]).x.transform("mean")
    means = {"x": ("x", "first"), "y": ("y", "mean"), "dy": ("y", "std")}
    lines = [
        some.groupby("bin").agg(**means).dropna(subset="y").fillna(0).assign(panel=panel, label=label)
        for (panel, label), some in grouped(points, "panel", "label")
    ]
    return pd.concat(lines) if lines else points


def _in_panels(cells: pd.DataFrame) -> pd.DataFrame:
    """The cells with their panel, one per scene and number of views, and their label."""
    counts = cells.groupby([*KEYS]).seed.transform("size").groupby([cells.scene, cells.views])
    low = counts.transform("min").astype(str)
    high = counts.transform("max").astype(str)
    n = low.where(low == high, low + " to " + high)
    return cells.assign(panel=cells.scene + ", " + cells.views.astype(str) + " views, n = " + n, label=cells.method)


_SEEDS = "mean over seeds, bars of one sd"
_SHARES = f"""Gaussians whose mean gradient is over the densification threshold, by distance from the nearest camera, \
{OFF} and {PAPER}: {_SEEDS}; each point stands for a sixth of the initial points; a fit at its limit of Gaussians \
keeps those that it could not densify"""
_FOREST = """Paired differences of test PSNR over off, with 95 % intervals, of one scene over seeds; n pairs; from the \
same initial points, but for the default's"""
_CURVES = f"Test PSNR during the fit, {', '.join((*MAIN, AUTO))}: {_SEEDS}"
_CELLS = "Test PSNR against {}; one point per cell, filled by its start"
_PSNR = "test PSNR [dB]"
_PLOTS = {  # what each shows, its axes, and its caption, where {} is the first axis
    "forest": (_forest, "test PSNR over off, same seeds and views [dB]", "", _FOREST),
    "curves": (_curves, "step", _PSNR, _CURVES),
    "gap": (_scattered("gap"), "overfitting: PSNR, training less test views [dB]", _PSNR, _CELLS),
    "cost": (_scattered("cpu_seconds"), "CPU time of the fit [s]", _PSNR, _CELLS),
    "coadaptation": (_scattered("thousandths"), "co-adaptation [1e-3]", _PSNR, _CELLS),
    "thresholds": (_thresholds, "distance [median of the initial points]", "over the threshold [%]", _SHARES),
}
