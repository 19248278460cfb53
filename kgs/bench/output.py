"""What the benchmarks write: tables in Markdown and CSV, plots, and a mean with its spread."""

import csv
import math
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from kgs._support.errors import quantity
from kgs._support.machine import versions

Row = dict[str, Any]


def markdown_table(title: str, columns: Iterable[object], rows: Iterable[Iterable[object]], first: str = "") -> str:
    """A title, a table and an empty line; `columns` are the heads of all columns but the first, which is `first`."""
    cells = [[first, *map(str, columns)], *([str(cell) for cell in row] for row in rows)]
    cells.insert(1, ["---"] * len(cells[0]))
    return "\n".join([f"{title}:", "", *(f"| {' | '.join(row)} |" for row in cells), "", ""])


def mean_sd(values: Iterable[float], decimals: int) -> str:
    """As "24.31 (0.12)", mean and sample standard deviation; "24.31" of one number, "-" of none. NaN does not count."""
    numbers = [value for value in values if not math.isnan(value)]
    spread = f" ({statistics.stdev(numbers):.{decimals}f})" if len(numbers) > 1 else ""
    return f"{statistics.fmean(numbers):.{decimals}f}{spread}" if numbers else "-"


def write_results(path: Path, rows: list[Row], tables: str) -> None:
    """Print the tables, Markdown, and write them as path.md, with versions and threads; path.csv: the rows."""
    with path.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    *packages, (_, machine) = versions().items()
    made = f"Made with {', '.join(' '.join(package) for package in packages)}; {machine}, "
    tables += f"{made}{quantity(torch.get_num_threads(), 'thread')} of torch.\n"
    path.with_suffix(".md").write_text(tables, encoding="utf-8")
    print(tables)


def write_plot(path: Path, panels: dict[str, dict[str, tuple[Any, str]]], rows: int = 1, **axes: Any) -> None:
    """Panels by title, in each lines by label: points `(P, 2)` and matplotlib's format string; both axes logarithmic.

    The first panel's legend is that of all; `axes` are settings of each, as matplotlib's Axes.set takes them.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, LogLocator

    columns = math.ceil(len(panels) / rows)
    figure = Figure(figsize=(3.6 * columns, 3.4 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axis, (title, lines) in zip(grid.flat, panels.items(), strict=False):
        for label, (points, look) in lines.items():
            axis.loglog(*zip(*points, strict=True), look, markersize=5, linewidth=1, alpha=0.8, label=label)
        axis.set(title=title, **axes)
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set(major_formatter=EngFormatter(sep=""), minor_formatter="")
        axis.grid(alpha=0.3)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    figure.savefig(path, dpi=100)
