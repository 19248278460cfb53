"""Numbers of metrics.json as the page shows them: rows of tables, facts, curves. No path of a disk gets through."""

import math
import re
from collections.abc import Iterable, Mapping
from pathlib import PurePosixPath, PureWindowsPath
from typing import Any

MEASURES = {
    "psnr": ("PSNR [dB]", 2),
    "ssim": ("SSIM", 3),
    "ssim_zero_padded": ("SSIM (zero padded)", 3),
    "lpips_vgg": ("LPIPS", 3),
}
PARTS = {"test": "held out", "train": "training", "views": "photos"}
_PATH = re.compile(
    r"(?<![\w.:/\\])(?:[A-Za-z]:)?[\\/](?:[^\\/\s]+[\\/])+(?=[^\\/\s])"
)  # the folders of an absolute one
_WIDTH, _HEIGHT = 640, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 48, 620, 12, 230

Runs = Mapping[str, Mapping[str, Any]]


def shareable(value: Any) -> str:
    """A value as text, in which a path that leaves the folder is its last name."""
    text = str(value)
    outside = text.startswith(("~", "../", "..\\"))
    if outside or PurePosixPath(text).is_absolute() or PureWindowsPath(text).is_absolute():
        return PureWindowsPath(text).name
    return _PATH.sub("", text)


def facts(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Simple values by their names, in words; of dicts inside too, of lists where all they hold is simple."""
    found = dict[str, str]()
    for name, value in values.items():
        title = prefix + str(name).replace("_", " ")
        if isinstance(value, Mapping):
            found |= facts(value, f"{title}: ")
        elif isinstance(value, list | tuple) and all(isinstance(each, str | int | float) for each in value):
            found[title] = ", ".join(map(_plain, value)) or "none"
        elif value is None or isinstance(value, str | int | float):
            found[title] = _plain(value)
    return found


def levels(runs: Runs) -> dict[str, str]:
    """The headline: each measure of held-out views, or where there are none of training views, of each run."""
    found = dict[str, str]()
    for run, metrics in runs.items():
        part = next((part for part in PARTS if metrics.get(part)), None)
        for key, (title, digits) in MEASURES.items():
            value = metrics[part].get(key) if part else None
            if part and value is not None and key != "ssim_zero_padded":
                count = len(metrics[part]["views"])
                name = f"{title}, {PARTS[part]} ({count} view{'s' * (count != 1)})" + f", {run}" * bool(run)
                found[name] = f"{value:.{digits}f}"
    return found


def measures(runs: Runs) -> tuple[list[str], list[list[str]]]:
    """Head and rows of a table, a row for each measure: means over views, with the least and the greatest."""
    measured = [(run, part, metrics[part]) for run, metrics in runs.items() for part in PARTS if metrics.get(part)]
    head, rows = [""], list[list[str]]()
    for run, part, values in measured:
        head.append(f"{PARTS[part]} ({len(values['views'])}){', ' * bool(run)}{run}")
    for key, (title, digits) in MEASURES.items():
        row = [title]
        for _, _, values in measured:
            mean, each = values.get(key), [view[key] for view in values["views"] if view.get(key) is not None]
            text = "" if mean is None else f"{mean:.{digits}f}"
            if text and len(each) > 1:
                text += f" ({min(each):.{digits}f} to {max(each):.{digits}f})"
            row.append(text)
        rows += [row] if any(row[1:]) else []
    return head, rows


def plot(runs: Runs) -> dict[str, Any] | None:
    """PSNR against seconds, in the coordinates of an SVG; None where no run has a curve of two points."""
    lines = [
        (series, part, run, [(p["seconds"], p[f"{part}_psnr"]) for p in metrics.get("curve") or []])
        for series, (run, metrics) in enumerate(runs.items())
        for part in ("test", "train")
    ]
    lines = [(series, part, run, [p for p in points if p[1] is not None]) for series, part, run, points in lines]
    lines = [line for line in lines if len(line[3]) > 1]
    if not lines:
        return None
    seconds = _ticks(point[0] for line in lines for point in line[3])
    level = _ticks(point[1] for line in lines for point in line[3])

    def x(value: float) -> float:
        return round(_LEFT + (_RIGHT - _LEFT) * (value - seconds[0]) / (seconds[-1] - seconds[0]), 1)

    def y(value: float) -> float:
        return round(_BOTTOM - (_BOTTOM - _TOP) * (value - level[0]) / (level[-1] - level[0]), 1)

    return {
        "width": _WIDTH,
        "height": _HEIGHT,
        **{"left": _LEFT, "right": _RIGHT, "top": _TOP, "bottom": _BOTTOM},
        "across": [(x(value), f"{value:g}") for value in seconds],
        "upwards": [(y(value), f"{value:g}") for value in level],
        "lines": [
            {"series": series, "dotted": part == "train", "label": f"{PARTS[part]}{', ' * bool(run)}{run}"}
            | {"points": " ".join(f"{x(a)},{y(b)}" for a, b in points)}
            for series, part, run, points in lines
        ],
    }


def _ticks(values: Iterable[float]) -> list[float]:
    """A few round numbers that enclose all values; values within a hundredth of each other count as one."""
    found = list(values)
    low, span = min(found), max(max(found) - min(found), 0.01)
    magnitude = 10 ** math.floor(math.log10(span / 4))
    step = next((s * magnitude for s in (5, 2) if s * magnitude <= span / 4), magnitude)
    first, last = math.floor(low / step), math.ceil((low + span) / step)
    return [round(i * step, 10) for i in range(first, last + 1)]


def _plain(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else shareable(value)
