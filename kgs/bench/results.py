"""What a benchmark leaves in its folder: its rows as CSV, everything as JSON, its tables in Markdown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from kgs.fit.machine import versions
from kgs.fit.outputs import write_json

from .output import write_csv

__all__ = ["write_results"]


def write_results(path: Path, rows: list[dict[str, Any]], tables: str, **more: Any) -> None:
    """Write a .csv, a .json and a .md file, and print the tables.

    Args:
        path: the files without their endings.
        rows: lines of the CSV; each has the same keys.
        tables: Markdown.
        more: what the JSON holds beside "rows", "threads" and "versions".
    """
    write_csv(path.with_suffix(".csv"), rows)
    write_json(
        path.with_suffix(".json"), {"rows": rows, **more, "threads": torch.get_num_threads(), "versions": versions()}
    )
    path.with_suffix(".md").write_text(tables, encoding="utf-8")
    print(tables)
