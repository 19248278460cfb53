"""The report of the study: CSV, Markdown, plots and a page that one can cite, from any part of its cells."""

import json
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import ChoiceLoader, Environment, PackageLoader

from kgs._support.version import __version__
from kgs.bench.scenes import SYNTHETIC

from .findings import findings
from .pairs import COLUMNS, KEYS, ORIGIN, cells_frame
from .plots import write_plots
from .tables import sparse_tables
from .texts import counts, document

TITLE = "Sparse views: DropGaussian on and off at equal initial points"


def write_report(rows: Sequence[Mapping[str, Any]], out: Path, command: str, planned: int) -> str:
    """Write sparse.csv (a line per cell), sparse.md, index.html, and the plots that have something to show.

    Args:
        rows: dicts of "cell" and "result", any part of the study.
        out: the folder, made if it is not there.
        command: what makes this report again.
        planned: how many cells the study has when it is done.

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
    origin = _origin(rows, frame, command, planned)
    folders = ChoiceLoader([PackageLoader("kgs.study", ""), PackageLoader("kgs.app.page", "")])
    templates = Environment(loader=folders, autoescape=True, trim_blocks=True)
    templates.filters["parts"] = lambda text: re.split(r" (?=\[|or |\()", text)
    notes = templates.get_template("notes.txt").render().splitlines()
    text = document(TITLE, [*conclusions, *origin], tables) + "\n".join(f"- {note}" for note in notes) + "\n"
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


def _origin(rows: Sequence[Mapping[str, Any]], frame: pd.DataFrame, command: str, planned: int) -> list[str]:
    """Sentences: the command, how many cells of which days, and the commits and machines that made them."""
    dates = frame.date.dropna()
    days = f"; from {dates.min()} to {dates.max()}" if len(dates) else ""
    commits = [row["result"].get("revision") or "of no known commit" for row in rows]
    versions = [
        ", ".join(f"{name} {value}" for name, value in sorted(row["result"].get("versions", {}).items()))
        for row in rows
    ]
    return [
        f"Command: {command}.",
        f"Figures: {len(rows)} of {planned} cells{days}.",
        f"Cells by commit of kgs: {counts(commits)}.",
        f"Cells by versions and machine: {counts(versions)}.",
    ]
