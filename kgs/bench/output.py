"""What the benchmarks write: tables in Markdown and CSV, and a mean with its spread."""

from __future__ import annotations

import csv
import math
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import Any

__all__ = ["markdown_table", "mean_sd", "write_csv"]


def markdown_table(title: str, columns: Iterable[object], rows: Iterable[Iterable[object]], first: str = "") -> str:
    """A title, a table and an empty line.

    Args:
        title: the line before the table.
        columns: heads of all columns but the first.
        rows: the cells of each line, its name first.
        first: head of the first column.
    """
    cells = [[first, *map(str, columns)], *([str(cell) for cell in row] for row in rows)]
    cells.insert(1, ["---"] * len(cells[0]))
    return "\n".join([f"{title}:", "", *(f"| {' | '.join(row)} |" for row in cells), "", ""])


def mean_sd(values: Iterable[float], decimals: int) -> str:
    """As "24.31 (0.12)", mean and sample standard deviation; "24.31" of one number, "-" of none. NaN does not count."""
    numbers = [value for value in values if not math.isnan(value)]
    if not numbers:
        return "-"
    spread = f" ({statistics.stdev(numbers):.{decimals}f})" if len(numbers) > 1 else ""
    return f"{statistics.fmean(numbers):.{decimals}f}{spread}"


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """One line per dict; the first one's keys are the columns, in that order."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
