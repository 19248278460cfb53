"""The report of the study: CSV, Markdown, LaTeX, plots and a page that one can cite, from any part of its cells."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader

from kgs import __version__
from kgs.bench.output import markdown_table

from .cells import revision
from .plots import write_plots
from .presets import OFF, PAPER
from .tables import COLUMNS, KEYS, QUALITY, cells_frame, difference, each, findings, sparse_tables

__all__ = ["write_report"]

TITLE = "Sparse views: DropGaussian on and off at equal first points"


def write_report(rows: Sequence[Mapping[str, Any]], out: Path, command: str, planned: int) -> str:
    """Write sparse.csv (a line per cell), summary.csv (a line per group), sparse.md, sparse.tex, plots and index.html.

    sparse.tex holds the tables, to be put into a document with the package booktabs. Plots and tables that have nothing
    to show are left out. How to read all this is in notes.txt of this package.

    Args:
        rows: dicts of "cell" and "result", any part of the study.
        out: the folder, made if it is not there; the page names the commit of its sparse.jsonl, where git has one.
        command: what makes this report again.
        planned: how many cells the study has when it is done.

    Returns:
        What sparse.md holds.

    Raises:
        ValueError: no rows, or two cells that differ in nothing but the settings of their fits.
    """
    frame = cells_frame(rows)
    out.mkdir(parents=True, exist_ok=True)
    lines = frame.sort_index().assign(fit=frame.fit.map(lambda fit: json.dumps(fit, sort_keys=True)))
    lines = lines[[*KEYS, "seed", *COLUMNS, "init.kind", "fit"]]
    lines.rename(columns=lambda name: name.replace(".", "_")).to_csv(out / "sparse.csv", index=False)
    _summary(frame.sort_index()).to_csv(out / "summary.csv", index=False)
    tables, plots, results = sparse_tables(frame), write_plots(frame, out), findings(frame)
    origin = _origin([row["result"] for row in rows], out / "sparse.jsonl", planned)
    origin = [f"Command: {command}.", *origin]
    page = Environment(loader=PackageLoader("kgs.bench.study", ""), autoescape=True, trim_blocks=True)
    page.filters["parts"] = lambda text: re.split(r" (?=\[|or |\()", text)
    notes = page.get_template("notes.txt").render().splitlines()
    text = "\n".join([f"# {TITLE}", "", *(f"- {finding}" for finding in (*results, *origin)), "", ""])
    latex = "".join(f"% {sentence}\n" for sentence in (*results, *origin, *notes))
    for title, table in tables.items():
        text += markdown_table(title, table.columns[1:], table.to_numpy().tolist(), table.columns[0])
        caption = re.sub(r"([%_])", r"\\\1", title)
        body = table.to_latex(index=False, escape=True, caption=caption)
        latex += f"{{\\scriptsize\n{re.sub(r'(?<![A-Za-z0-9_-])-(?=[0-9])', '$-$', body)}}}\n\n"
    text += "\n".join(f"- {note}" for note in notes) + "\n"
    content: dict[str, Any] = {"title": TITLE, "findings": results, "origin": origin, "notes": notes, "tables": tables}
    content["pictures"] = {caption: b64encode((out / name).read_bytes()).decode() for name, caption in plots.items()}
    html = page.get_template("page.html.jinja").render(**content, version=__version__)
    for name, written in {"sparse.md": text, "sparse.tex": latex, "index.html": html}.items():
        (out / name).write_text(written, encoding="utf-8")
    return text


def _summary(frame: pd.DataFrame) -> pd.DataFrame:
    """The lines of summary.csv."""
    lines = []
    for (scene, views, start, method), cells in each(frame, *KEYS):
        line = dict(zip(KEYS, (scene, views, start, method), strict=True))
        line |= {"n": len(cells), "seeds": " ".join(map(str, sorted(cells.seed)))}
        for measure in COLUMNS:
            values, name = cells[measure], measure.replace(".", "_")
            line |= {f"{name}_mean": values.mean(), f"{name}_sd": values.std()}
            if measure.startswith("test."):
                line[f"{name}_best"] = values.min() if "lpips" in measure else values.max()
        same = frame[(frame.scene == scene) & (frame.views == views)]
        for name, pair in {"off": (method, OFF), "paper": (method, PAPER), "sift": (start, "sift")}.items():
            key, others = ("start", same.method == method) if name == "sift" else ("method", same.start == start)
            for measure in QUALITY:
                gain = difference(same[others], key, *pair, measure)
                found = gain._asdict() if gain.pairs else dict.fromkeys(gain._fields)
                line |= {f"{measure[5:]}_over_{name}_{part}": found[part] for part in ("mean", "low", "high", "pairs")}
        lines.append(line)
    return pd.DataFrame(lines)


def _origin(results: Sequence[Mapping[str, Any]], path: Path, planned: int) -> list[str]:
    """Where the figures are from: how many cells, their commit and dates, and the versions that they ran with."""
    found = {key: sorted({r[key] for r in results if r.get(key)}) for key in ("date", "revision")}
    versions = {", ".join(f"{k} {v}" for k, v in sorted(r.get("versions", {}).items())): None for r in results}
    commit, dates = revision(path), found["date"]
    made = [f"{len(results)} of {planned} cells"]
    made += [f"{path.name} at commit {commit}"] if commit else []
    made += [f"cells that say when they ran: {dates[0]} to {dates[-1]}"] if dates else []
    made += [f"cells that say of which code: {', '.join(found['revision'])}"] if found["revision"] else []
    return [f"Figures: {'; '.join(made)}.", f"Versions: {'; '.join(versions)}."]
