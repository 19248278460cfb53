"""What the benchmarks write: tables in Markdown, CSV and JSON, and a mean with its spread."""

import csv
import math
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from kgs.fit.machine import versions
from kgs.fit.outputs import write_json

Row = dict[str, Any]


def markdown_table(title: str, columns: Iterable[object], rows: Iterable[Iterable[object]], first: str = "") -> str:
    """A title, a table and an empty line; `columns` are the heads of all columns but the first, which is `first`."""
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


def write_results(path: Path, rows: list[Row], tables: str, **more: Any) -> None:
    """Write a benchmark's .csv, .json and .md file, and print the tables.

    Args:
        path: the files without their endings.
        rows: lines of the CSV; all have the keys of the first.
        tables: Markdown.
        more: what the JSON holds beside "rows", "threads" and "versions".
    """
    with path.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    content = {"rows": rows, **more, "threads": torch.get_num_threads(), "versions": versions()}
    write_json(path.with_suffix(".json"), content)
    path.with_suffix(".md").write_text(tables, encoding="utf-8")
    print(tables)
