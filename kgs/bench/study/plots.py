"""The plots of the study and of the training sweep: one function draws them all, one colour and marker per method."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from .presets import FAMILIES, FIXED, MAIN, OFF, PAPER
from .tables import KEYS, STARTS, difference, each, main_cells

# Colours of Okabe and Ito, told apart by colour-blind people too; those that share one differ in the marker.
STYLES = {OFF: ("#000000", "o"), PAPER: ("#0072B2", "s"), FIXED: ("#D55E00", "^")}
for _colour, _names in zip(("#E69F00", "#CC79A7", "#009E73"), FAMILIES.values(), strict=True):
    STYLES = {**{name: (_colour, marker) for name, marker in zip(_names, "vD^p*<>", strict=False)}, **STYLES}
_FILLS = dict(zip(STARTS, ("none", "left", "bottom", "top", "full", "right"), strict=True))  # of a start's markers
DPI = 110


def panels(points: pd.DataFrame, styles: dict[str, tuple[str, str]] = STYLES, **axes: Any) -> Figure:
    """One panel per value of the column "panel", two in a row, and one legend for all.

    Args:
        points: columns "panel", "label", "x", "y", and where they are known "dx" and "dy" (half the length of a bar),
            "start" (fills the markers; without it a line joins them), and "name" (stands at the y axis).
        styles: colour and marker by label; others get the next colour.
        axes: settings of every panel, as matplotlib's Axes.set takes them.
    """
    styles = {label: (f"C{k}", ".") for k, label in enumerate(points.label.unique())} | styles
    titles, scattered, named = points.panel.unique(), "start" in points, "name" in points
    columns, rows = min(2, len(titles)), -(-len(titles) // 2)
    size = (9, 0.9 + 0.2 * len(points)) if named else (3.9 * columns + 0.4, 3.2 * rows + 0.5)
    figure, found = Figure(size, dpi=DPI, layout="constrained"), dict[str, Any]()
    for place, ((title,), some) in enumerate(each(points, "panel"), 1):
        axis = figure.add_subplot(rows, columns, place)
        for (label, start), part in each(some.assign(start=some.get("start", "")), "label", "start"):
            colour, marker = styles[label]
            look: dict[str, Any] = {"marker": marker, "ls": "" if scattered or named else "-", "alpha": 0.85, "ms": 5}
            fill = _FILLS.get(start, "none" if scattered else "full")
            bars = axis.errorbar(part.x, part.y, part.get("dy"), part.get("dx"), c=colour, fillstyle=fill, **look)
            found.setdefault(label, bars)
            if scattered:
                found[f"from {start}"] = axis.plot([], [], "h", color="grey", fillstyle=fill)[0]
        axis.set_title(title, fontsize=9)
        axis.set(**axes)
        axis.grid(alpha=0.3)
        if named:
            axis.set_yticks(some.y, some.name, fontsize=8)
            axis.set_ylim(len(some) - 0.5, -0.5)
            axis.axvline(0, color="#777777", linewidth=1)
    if not named:
        labels = sorted(found, key=lambda label: label.startswith("from "))
        handles = [found[label] for label in labels]
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return figure


def write_plots(frame: pd.DataFrame, out: Path) -> dict[str, str]:
    """Write a PNG for each plot that has something to show; return the captions by file name."""
    captions = {}
    for name, (points_of, xlabel, ylabel, caption) in _PLOTS.items():
        points = points_of(frame)
        if len(points):
            panels(points, xlabel=xlabel, ylabel=ylabel).savefig(out / f"{name}.png")
            captions[f"{name}.png"] = caption
    return captions


def _forest(frame: pd.DataFrame) -> pd.DataFrame:
    """Every difference over off: first the means over the scenes' main settings, then each setting's own."""
    main = main_cells(frame)
    groups = {"mean over scenes": main[main.groupby("method").scene.transform("nunique") > 1]}
    groups |= {"{}, {} views, {}".format(*setting): cells for setting, cells in each(frame, *KEYS[:3])}
    lines = [
        {"label": method, "name": f"{where}: {method} (n = {gain.pairs})", "x": gain.mean, "dx": gain.high - gain.mean}
        for where, cells in groups.items()
        for method in cells.method.unique()
        if (gain := difference(cells, "method", method, OFF)).pairs
    ]
    return pd.DataFrame(lines).assign(panel="", y=range(len(lines)))


def _scattered(frame: pd.DataFrame, x: str) -> pd.DataFrame:
    cells = main_cells(frame, STARTS)
    known = {"gap": cells["train.psnr"] - cells["test.psnr"], "coadaptation": 1e3 * cells.coadaptation}
    return _in_panels(cells.assign(x=known.get(x, cells.cpu_seconds), y=cells["test.psnr"]).dropna(subset=["x", "y"]))


def _curves(frame: pd.DataFrame) -> pd.DataFrame:
    main = main_cells(frame)
    cells = main[main.method.isin(MAIN) & (main.curve.str.len() > 0)]
    curves = [{point["step"]: point["test_psnr"] for point in curve} for curve in cells.curve]
    return _over_seeds(cells, [pd.DataFrame(curves, cells.index, dtype=float)])


def _thresholds(frame: pd.DataFrame) -> pd.DataFrame:
    main = main_cells(frame)
    cells = main[main.method.isin((OFF, PAPER)) & main["thresholds.over"].notna()]
    shares = []
    for _, some in each(cells, "scene", "views"):
        keys = ("over", "gaussians", "distance")
        over, counts, edges = (np.array(some[f"thresholds.{key}"].tolist(), float) for key in keys)
        middle = (edges[:, 1:] + edges[:, :-1]).mean(0) / 2
        shares.append(pd.DataFrame(100 * over / np.where(counts > 0, counts, np.nan), some.index, middle))
    return _over_seeds(cells, shares)


def _over_seeds(cells: pd.DataFrame, values: list[pd.DataFrame]) -> pd.DataFrame:
    """Mean and standard deviation over the seeds, of tables with one row per cell and one column per place."""
    cells, lines = _in_panels(cells), []
    for (panel, label), some in each(cells, "panel", "label"):
        table = next(t for t in values if some.index[0] in t.index).loc[some.index].dropna(axis=1, how="all")
        table = table.sort_index(axis=1)
        points = pd.DataFrame({"x": table.columns, "y": table.mean().array, "dy": table.std().fillna(0).array})
        lines.append(points.assign(panel=panel, label=label))
    return pd.concat(lines) if lines else cells


def _in_panels(cells: pd.DataFrame) -> pd.DataFrame:
    """The cells with their panel, one per scene and number of views, and their label."""
    counts = cells.groupby([*KEYS]).seed.transform("size").groupby([cells.scene, cells.views])
    low, high = counts.transform("min").astype(str), counts.transform("max").astype(str)
    n = low.where(low == high, low + " to " + high)
    return cells.assign(panel=cells.scene + ", " + cells.views.astype(str) + " views, n = " + n, label=cells.method)


_GAP = "overfitting: PSNR, training less test views [dB]"
_GAIN = "test PSNR over off, same first points and views [dB]"
_DISTANCE, _PSNR = "distance [median of the first points]", "test PSNR [dB]"
_CELLS = "one point per cell, filled by its start"
_CURVES = f"Test PSNR during the fit, {', '.join(MAIN)}: mean over seeds, bars of one sd"
_SHARES = (
    "Gaussians whose mean gradient is over the densification threshold, by distance from the nearest camera, "
    f"{OFF} and {PAPER}: mean over seeds, bars of one sd; each point stands for a sixth of the first points; a fit at "
    "its limit of Gaussians keeps those that it could not densify"
)
# What each plot shows, its axes, and its caption.
_PLOTS = {"forest": (_forest, _GAIN, "", "Paired differences of test PSNR over off, with 95 % intervals; n pairs")}
_PLOTS["curves"] = (_curves, "step", _PSNR, _CURVES)
for _name, _x in {"gap": _GAP, "cost": "CPU time of the fit [s]", "coadaptation": "co-adaptation [1e-3]"}.items():
    _PLOTS[_name] = (partial(_scattered, x=_name), _x, _PSNR, f"Test PSNR against {_x}; {_CELLS}")
_PLOTS["thresholds"] = (_thresholds, _DISTANCE, "over the threshold [%]", _SHARES)
