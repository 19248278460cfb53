"""What the benchmarks write: tables in Markdown, LaTeX, HTML and CSV."""

from __future__ import annotations

import csv
import html
import math
import re
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import Any

__all__ = ["html_table", "latex_escape", "latex_table", "markdown_table", "mean_sd", "write_csv"]

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "[": "{[}",
        "<": "$<$",
        ">": "$>$",
        **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    }
)


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


def latex_table(title: str, columns: Iterable[object], rows: Iterable[Iterable[object]], first: str = "") -> str:
    """The same as a table of LaTeX that needs no package: a float with the title as its caption, and an empty line."""
    head = [first, *map(str, columns)]
    lines = [" & ".join(latex_escape(str(cell)) for cell in row) + r" \\" for row in (head, *rows)]
    return "\n".join(
        [
            r"\begin{table}[htbp]",
            r"\centering\scriptsize\setlength{\tabcolsep}{3pt}\renewcommand{\arraystretch}{1.2}",
            rf"\caption{{{latex_escape(title)}}}\smallskip",
            rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}",
            rf"\hline {lines[0]} \hline",
            *lines[1:],
            r"\hline",
            r"\end{tabular}",
            r"\end{table}",
            "",
            "",
        ]
    )


def latex_escape(text: str) -> str:
    """Text for LaTeX: its special characters and "--" as themselves, a minus before a number as a minus."""
    return re.sub(r"(?<![\w-])-(?=\d)", "$-$", text.translate(_LATEX).replace("--", "-{}-"))


def html_table(title: str, columns: Iterable[object], rows: Iterable[Iterable[object]], first: str = "") -> str:
    """The same in HTML: a figure with the title as its caption, the table itself in a `div` of the class "scroll"."""
    head = "".join(f'<th scope="col">{html.escape(str(cell))}</th>' for cell in (first, *columns))
    body = []
    for row in rows:
        name, *cells = (html.escape(str(cell)) for cell in row)
        body.append(f'<tr><th scope="row">{name}</th>{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>')
    begin = f'<figure><figcaption>{html.escape(title)}</figcaption>\n<div class="scroll"><table>'
    end = "</tbody>\n</table></div></figure>"
    return "\n".join([begin, f"<thead><tr>{head}</tr></thead>", "<tbody>", *body, end, ""])


def mean_sd(values: Iterable[float], decimals: int) -> str:
    """As "24.31 (0.12)", mean and sample standard deviation; "24.31" of one number, "-" of none. NaN does not count."""
    numbers = [value for value in values if not math.isnan(value)]
    if not numbers:
        return "-"
    spread = f" ({statistics.stdev(numbers):.{decimals}f})" if len(numbers) > 1 else ""
    return f"{statistics.fmean(numbers):.{decimals}f}{spread}"


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """One line a dict; the first one's keys are the columns, in that order."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
