"""The report of the study: CSV, Markdown, plots and a page that one can cite, from any part of its cells."""

import json
import re
from base64 import b64encode
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import ChoiceLoader, Environment, PackageLoader

from kgs._support.machine import revision
from kgs._support.version import __version__
from kgs.bench.output import markdown_table
from kgs.bench.scenes import SYNTHETIC

from .findings import findings
from .pairs import COLUMNS, KEYS, ORIGIN, cells_frame
from .plots import write_plots
from .tables import sparse_tables

TITLE = "Sparse views: DropGaussian on and off at equal initial points"


def write_report(
    rows: Sequence[Mapping[str, Any]], out: Path, command: str, planned: int, source: Path | None = None
) -> str:
    """Write sparse.csv (a line per cell), sparse.md, index.html, and the plots that have something to show.

    Args:
        rows: dicts of "cell" and "result", any part of the study.
        out: the folder, made if it is not there.
        command: what makes this report again.
        planned: how many cells the study has when it is done.
        source: the file of the rows; the page names its commit, where git has one.

    Returns what sparse.md holds; ValueError as of `cells_frame`.
    """
    frame = cells_frame(rows)
    out.mkdir(parents=True, exist_ok=True)
    _write_csv(frame, out / "sparse.csv")
    real = frame[frame.scene != SYNTHETIC]
    told = real if len(real) else frame
    tables = sparse_tables(told)
    plots = write_plots(told, out)
    conclusions = findings(told)
    origin = _origin(rows, frame, source, command, planned)
    folders = ChoiceLoader([PackageLoader("kgs.study", ""), PackageLoader("kgs.app.page", "")])
    templates = Environment(loader=folders, autoescape=True, trim_blocks=True)
    templates.filters["parts"] = lambda text: re.split(r" (?=\[|or |\()", text)
    notes = templates.get_template("notes.txt").render().splitlines()
    text = "\n".join([f"# {TITLE}", "", *(f"- {sentence}" for sentence in (*conclusions, *origin)), "", ""])
    for title, table in tables.items():
        text += markdown_table(title, table.columns[1:], table.to_numpy().tolist(), table.columns[0])
    text += "\n".join(f"- {note}" for note in notes) + "\n"
    html = templates.get_template("page.html.jinja").render(
        title=TITLE,
        findings=conclusions,
        origin=origin,
        notes=notes,
        tables=tables,
        shown=[row for row in rows if "pictures" in row["result"]],
        pictures={caption: b64encode((out / name).read_bytes()).decode() for name, caption in plots.items()},
        version=__version__,
    )
    (out / "sparse.md").write_text(text, encoding="utf-8")
    (out / "index.html").write_text(html, encoding="utf-8")
    return text


def _write_csv(frame: pd.DataFrame, path: Path) -> None:
    """A line per cell, in the order of the rows."""
    lines = frame.sort_index().assign(fit=frame.fit.map(lambda fit: json.dumps(fit, sort_keys=True)))
    lines = lines[[*KEYS, "seed", *COLUMNS, "init.kind", *ORIGIN, "fit"]]
    lines.rename(columns=lambda name: name.replace(".", "_")).to_csv(path, index=False)


def _origin(
    rows: Sequence[Mapping[str, Any]], frame: pd.DataFrame, source: Path | None, command: str, planned: int
) -> list[str]:
    """Sentences: the command, how many cells of which days, and the commits and machines that made them."""
    figures = [f"{len(rows)} of {planned} cells"]
    commit = revision(source) if source else None
    if source and commit:
        figures.append(f"{source.name} at commit {commit}")
    dates = frame.date.dropna()
    if len(dates):
        figures.append(f"from {dates.min()} to {dates.max()}")
    commits = [row["result"].get("revision") or "of no known commit" for row in rows]
    versions = [
        ", ".join(f"{name} {value}" for name, value in sorted(row["result"].get("versions", {}).items()))
        for row in rows
    ]
    return [
        f"Command: {command}.",
        f"Figures: {'; '.join(figures)}.",
        f"Cells by commit of kgs: {_counts(commits)}.",
        f"Cells by versions and machine: {_counts(versions)}.",
    ]


def _counts(values: Iterable[str]) -> str:
    """As "200 a; 25 b", the most frequent first."""
    return "; ".join(f"{count} {value}" for value, count in Counter(values).most_common())
