"""What the benchmarks write: tables in Markdown and CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

__all__ = ["markdown_table", "write_csv"]


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


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """One line a dict; the first one's keys are the columns, in that order."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
