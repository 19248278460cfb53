"""The plots of the study of sparse views: one colour and marker a method in all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .published import PAPER
from .sparse_groups import MAIN, OFF, Groups, all_settings, main_settings, ordered, over
from .statistics import Difference, Group, by_seed, paired, paired_difference, summarize

__all__ = ["Plot", "write_plots"]

# Colours of Okabe and Ito, told apart by colour-blind people too; those that share one differ in the marker.
_BLACK, _ORANGE, _SKY, _GREEN, _BLUE, _RED, _PINK = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73"),
    *("#0072B2", "#D55E00", "#CC79A7"),
)
STYLES: dict[str, tuple[str, str]] = {
    "off": (_BLACK, "o"),
    "progressive 0.2": (_BLUE, "s"),
    "fixed 0.1": (_RED, "^"),
    "progressive 0.1": (_SKY, "v"),
    "progressive 0.3": (_SKY, "D"),
    "fixed 0.05": (_ORANGE, "v"),
    "fixed 0.15": (_ORANGE, "D"),
    "fixed 0.2": (_ORANGE, "p"),
    "fixed 0.3": (_ORANGE, "*"),
    "high gradient": (_PINK, "v"),
    "low gradient": (_PINK, "^"),
    "near": (_PINK, "<"),
    "far": (_PINK, ">"),
    "L1 gradient 0.001": (_GREEN, "v"),
    "L1 gradient 0.01": (_GREEN, "^"),
    "L1 distance 0.001": (_GREEN, "<"),
    "L1 distance 0.01": (_GREEN, ">"),
}
_OTHER = ("#777777", "x")
# How a start fills its markers.
_FILLS = {
    "dense": "full",
    "sift": "none",
    "random": "left",
    "model-points": "bottom",
    "full-model": "top",
    "scene": "right",
}
PANEL = (3.9, 3.2)  # inches
DPI = 110


class Plot(NamedTuple):
    """A picture that was written, and what it shows."""

    path: Path
    caption: str


def write_plots(groups: Groups, out: Path) -> list[Plot]:
    """Write a PNG for each plot that has something to show.

    Args:
        groups: the results.
        out: the folder.
    """
    pair = f"{OFF} and {PAPER}"
    plots: dict[str, tuple[Callable[[Groups, Path], bool], str]] = {
        "forest.png": (_forest, "Paired differences of test PSNR over off, with 95 % intervals; n pairs"),
        "curves.png": (_curves, f"Test PSNR during the fit, {', '.join(MAIN)}: mean over seeds, band of one sd"),
        "gap.png": (_gap, "PSNR of training views less that of test views: each seed, and the mean as a bar"),
        "cost.png": (
            _cost,
            "Test PSNR against CPU time: one point a cell, each start with its filling",
        ),
        "coadaptation.png": (
            _coadaptation,
            "Test PSNR against co-adaptation, the variance of random halves' renders: one point a cell, as above",
        ),
        "thresholds.png": (
            _thresholds,
            f"Gaussians whose mean gradient is over the densification threshold, by distance from the nearest camera, "
            f"{pair}: mean over seeds, bars of one sd; each bin began with a sixth of the first points; a fit at "
            "its limit of Gaussians keeps those that it could not densify",
        ),
    }
    return [Plot(out / name, caption) for name, (draw, caption) in plots.items() if draw(groups, out / name)]


def _forest(groups: Groups, path: Path) -> bool:
    """Every difference over off: first the means over the scenes' main settings, then each setting's own."""
    chosen = {f"{s.scene}, {s.views} views, {s.start}": [s] for s in all_settings(groups)}
    lines: list[tuple[str, Difference | None]] = []
    for where, settings in {"mean over scenes": main_settings(groups), **chosen}.items():
        found = []
        for method in ordered(group.method for group in groups if group.method != OFF):
            scenes = [over(groups, setting._replace(method=method), method=OFF) for setting in settings]
            difference = paired_difference(scenes)
            if difference is not None and (where in chosen or sum(map(bool, scenes)) > 1):
                found.append((method, difference))
        lines += [(where, None), *found] if found else []
    if not lines:
        return False
    figure = _figure(7.5, 0.9 + 0.22 * len(lines))
    axis = figure.subplots()
    labels = [where if d is None else f"{where} (n = {d.pairs})" for where, d in lines]
    axis.set_yticks(range(len(lines)), labels, fontsize=8)
    for level, (name, difference) in enumerate(lines):
        if difference is None:
            axis.get_yticklabels()[level].set_fontweight("bold")
            continue
        colour, marker = STYLES.get(name, _OTHER)
        if difference.low is not None:
            axis.plot([difference.low, difference.high], [level, level], color=colour, linewidth=1.5)
        axis.plot(difference.mean, level, marker, color=colour, markersize=5)
    axis.axvline(0, color="#777777", linewidth=1)
    axis.set_ylim(len(lines) - 0.5, -0.5)
    axis.tick_params(axis="y", length=0)
    axis.set_xlabel("test PSNR over off, same first points and views [dB]")
    axis.grid(axis="x", alpha=0.3)
    figure.savefig(path)
    return True


def _curves(groups: Groups, path: Path) -> bool:
    def draw(axis: Any, group: Group) -> bool:
        curves = [_curve(result) for result in groups.get(group, {}).values()]
        steps = sorted(set(curves[0]).intersection(*curves[1:])) if curves else []
        if not steps:
            return False
        values = np.array([[curve[step] for step in steps] for curve in curves])
        colour, marker = STYLES.get(group.method, _OTHER)
        axis.plot(steps, values.mean(0), color=colour, marker=marker, markersize=4, label=group.method)
        if len(curves) > 1:
            spread = values.std(0, ddof=1)
            axis.fill_between(steps, values.mean(0) - spread, values.mean(0) + spread, color=colour, alpha=0.15, lw=0)
        return True

    return _panels(groups, path, MAIN, draw, "step", "test PSNR [dB]")


def _curve(result: Any) -> dict[int, float]:
    return {point["step"]: point["test_psnr"] for point in result["curve"] if point["test_psnr"] is not None}


def _thresholds(groups: Groups, path: Path) -> bool:
    def draw(axis: Any, group: Group) -> bool:
        found = [result["thresholds"] for result in groups.get(group, {}).values() if result.get("thresholds")]
        if not found:
            return False
        over_it, counts = (np.array([entry[key] for entry in found], float) for key in ("over", "gaussians"))
        columns = zip(over_it.T, counts.T, strict=True)  # of bins: one number a seed
        shares = [summarize(100 * some[every > 0] / every[every > 0]) for some, every in columns]
        drawn = [(k, share) for k, share in enumerate(shares) if share is not None]
        if not drawn:
            return False
        colour, marker = STYLES.get(group.method, _OTHER)
        axis.errorbar(
            [k + 0.46 + 0.08 * (group.method == PAPER) for k, _ in drawn],
            [share.mean for _, share in drawn],
            [share.sd or 0.0 for _, share in drawn],
            **{"color": colour, "marker": marker, "markersize": 4, "capsize": 2},
            label=group.method,
        )
        edges = np.array([entry["distance"] for entry in found]).mean(0)
        axis.set_xticks(range(len(edges)), [f"{edge:.2g}" for edge in edges])
        axis.autoscale(axis="y")
        axis.set_ylim(bottom=0)
        return True

    return _panels(groups, path, (OFF, PAPER), draw, "distance [median of the first points]", "over the threshold [%]")


def _gap(groups: Groups, path: Path) -> bool:
    settings = [s for s in main_settings(groups) if any(s._replace(method=method) in groups for method in MAIN)]
    found = {
        (x, method): paired(by_seed(results, "train.psnr"), by_seed(results, "test.psnr"))
        for x, setting in enumerate(settings)
        for method in MAIN
        if (results := groups.get(setting._replace(method=method)))
    }
    if not any(found.values()):
        return False
    figure = _figure(max(4.5, 1.5 * len(settings) + 1), 3.4)
    axis = figure.subplots()
    for (x, method), gaps in found.items():
        colour, marker = STYLES[method]
        place = x + 0.22 * (MAIN.index(method) - 1)
        axis.plot([place] * len(gaps), gaps, marker, color=colour, markersize=4, label=method, clip_on=False)
        if gaps:
            axis.plot([place - 0.08, place + 0.08], [np.mean(gaps)] * 2, color=colour, linewidth=2)
    labels = [f"{s.scene}\n{s.views} views, n = {_counts(groups, s, MAIN)}" for s in settings]
    axis.set_xticks(range(len(settings)), labels, fontsize=8)
    axis.set_xlim(-0.5, len(settings) - 0.5)
    axis.set_ylabel("PSNR, training less test views [dB]")
    axis.grid(axis="y", alpha=0.3)
    _legend(figure, [axis])
    figure.savefig(path)
    return True


def _cost(groups: Groups, path: Path) -> bool:
    return _scatter(groups, path, "cpu_seconds", 1.0, "CPU time of the fit [s]")


def _coadaptation(groups: Groups, path: Path) -> bool:
    return _scatter(groups, path, "coadaptation", 1e3, "co-adaptation [1e-3]")


def _scatter(groups: Groups, path: Path, measure: str, scale: float, x_label: str) -> bool:
    """Test PSNR of every cell of each main setting's scene and views, over another of its numbers."""
    main = {setting[:2] for setting in main_settings(groups)}
    methods = ordered(group.method for group in groups if group[:2] in main)

    def draw(axis: Any, group: Group) -> bool:
        some = False
        colour, marker = STYLES.get(group.method, _OTHER)
        others = [other for other in groups if other[:2] == group[:2]]
        for other in (o for o in others if o.method == group.method):
            x, y = by_seed(groups[other], measure), by_seed(groups[other], "test.psnr")
            seeds = sorted(x.keys() & y.keys())
            points = [scale * x[seed] for seed in seeds], [y[seed] for seed in seeds]
            style = {"fillstyle": _FILLS.get(other.start, "none"), "markersize": 5, "alpha": 0.85}
            label = group.method if other.start == group.start else None
            axis.plot(*points, marker, color=colour, label=label, **style)
            some = some or bool(seeds)
        if group.method == methods[-1]:  # the legend has the starts after the methods
            for start in dict.fromkeys(other.start for other in others):
                axis.plot([], [], "h", color="grey", fillstyle=_FILLS.get(start, "none"), label=f"from {start}")
        return some

    return _panels(groups, path, methods, draw, x_label, "test PSNR [dB]")


def _panels(
    groups: Groups,
    path: Path,
    methods: Sequence[str],
    draw: Callable[[Any, Group], bool],
    x_label: str,
    y_label: str,
) -> bool:
    """One panel a main setting that has a cell of the methods, two a row, and one legend for all."""
    there = {(group.scene, group.views) for group in groups if group.method in methods}
    settings = [setting for setting in main_settings(groups) if setting[:2] in there]
    if not settings:
        return False
    columns = min(2, len(settings))
    rows = math.ceil(len(settings) / columns)
    figure = _figure(PANEL[0] * columns + 0.4, PANEL[1] * rows + 0.5)
    axes = figure.subplots(rows, columns, squeeze=False).flat
    used = []
    for axis, setting in zip(axes, settings, strict=False):
        if any([draw(axis, setting._replace(method=method)) for method in methods]):
            counts = _counts(groups, setting, methods)
            axis.set_title(f"{setting.scene}, {setting.views} views, {setting.start}, n = {counts}", fontsize=9)
            axis.set_xlabel(x_label)
            axis.set_ylabel(y_label)
            axis.grid(alpha=0.3)
            used.append(axis)
    for axis in set(figure.axes) - set(used):
        axis.remove()
    if used:
        _legend(figure, used)
        figure.savefig(path)
    return bool(used)


def _counts(groups: Groups, setting: Group, methods: Sequence[str]) -> str:
    """How many seeds those of the methods have that are there, the fewest and the most."""
    counts = {len(results) for method in methods if (results := groups.get(setting._replace(method=method)))} or {0}
    return " to ".join(str(count) for count in sorted({min(counts), max(counts)}))


def _legend(figure: Any, axes: Sequence[Any]) -> None:
    """One for the figure, below it; each label once."""
    found = {label: handle for axis in axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(found.values(), found.keys(), loc="outside lower center", ncols=4, frameon=False, fontsize=8)


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    return Figure(figsize=(width, height), dpi=DPI, layout=ConstrainedLayoutEngine(wspace=0.08, hspace=0.08))
