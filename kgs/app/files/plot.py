"""The PSNR during a fit as lines and ticks in a picture, for the page's SVG and for a PNG."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

# Names of the sets of views by their keys in metrics.json.
PARTS = {"test": "held out", "held_out": "held out of another fit", "train": "training", "views": "photos"}
# The plot, in its own units: its size, and the borders of the area with the lines.
_WIDTH = 640
_HEIGHT = 260
_LEFT = 48
_RIGHT = 620
_TOP = 12
_BOTTOM = 230

Runs = Mapping[str, Mapping[str, Any]]  # the content of metrics.json by the name of the run; "" if there is only one
Curve = tuple[str, str, str, list[tuple[float, float]]]  # run, key of the part, label, (seconds, PSNR)


def psnr_plot(runs: Runs) -> dict[str, Any] | None:
    """PSNR over the seconds of training in the coordinates of a picture; None if no curve has two points."""
    curves = list[Curve]()
    for run, metrics in runs.items():
        for part in ("test", "train"):
            curve = [(point["seconds"], point[f"{part}_psnr"]) for point in metrics.get("curve") or []]
            points = [(seconds, psnr) for seconds, psnr in curve if psnr is not None]
            if len(points) > 1:
                curves.append((run, part, with_run(PARTS[part], run), points))
    if not curves:
        return None
    seconds = _ticks([point[0] for *_, points in curves for point in points])
    levels = _ticks([point[1] for *_, points in curves for point in points])

    def x(value: float) -> float:
        return round(_LEFT + (_RIGHT - _LEFT) * (value - seconds[0]) / (seconds[-1] - seconds[0]), 1)

    def y(value: float) -> float:
        return round(_BOTTOM - (_BOTTOM - _TOP) * (value - levels[0]) / (levels[-1] - levels[0]), 1)

    return {
        "width": _WIDTH,
        "height": _HEIGHT,
        "left": _LEFT,
        "right": _RIGHT,
        "top": _TOP,
        "bottom": _BOTTOM,
        "x_ticks": [(x(value), f"{value:g}") for value in seconds],
        "y_ticks": [(y(value), f"{value:g}") for value in levels],
        "lines": [
            {
                "method": "without" if run.startswith("without") else "default",
                "dotted": part == "train",
                "label": label,
                "points": " ".join(f"{x(a)},{y(b)}" for a, b in points),
            }
            for run, part, label, points in curves
        ],
    }


def _ticks(values: Sequence[float]) -> list[float]:
    """A few round numbers that enclose all values; a span of less than 0.01 is extended to 0.01."""
    low = min(values)
    span = max(max(values) - low, 0.01)
    magnitude = 10 ** math.floor(math.log10(span / 4))
    step = next((s * magnitude for s in (5, 2) if s * magnitude <= span / 4), magnitude)
    first = math.floor(low / step)
    last = math.ceil((low + span) / step)
    return [round(i * step, 10) for i in range(first, last + 1)]


def with_run(text: str, run: str) -> str:
    """A label, followed by the name of its run if that has one."""
    return f"{text}, {run}" if run else text
