"""The report of the study: CSV, Markdown, plots and a page that one can cite, from any part of its cells."""

import json
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader

from kgs import __version__
from kgs.bench.output import markdown_table

from .cells import revision
from .plots import write_plots
from .tables import COLUMNS, KEYS, cells_frame, findings, sparse_tables

TITLE = "Sparse views: DropGaussian on and off at equal first points"


def write_report(rows: Sequence[Mapping[str, Any]], out: Path, command: str, planned: int) -> str:
    """Write sparse.csv (a line per cell), sparse.md, index.html, and the plots that have something to show.

    Args:
        rows: dicts of "cell" and "result", any part of the study.
        out: the folder, made if it is not there; the page names the commit of its sparse.jsonl, where git has one.
        command: what makes this report again.
        planned: how many cells the study has when it is done.

    Returns what sparse.md holds; ValueError as of `cells_frame`.
    """
    frame = cells_frame(rows)
    out.mkdir(parents=True, exist_ok=True)
    lines = frame.sort_index().assign(fit=frame.fit.map(lambda fit: json.dumps(fit, sort_keys=True)))
    lines = lines[[*KEYS, "seed", *COLUMNS, "init.kind", "fit"]]
    lines.rename(columns=lambda name: name.replace(".", "_")).to_csv(out / "sparse.csv", index=False)
    tables, plots, results = sparse_tables(frame), write_plots(frame, out), findings(frame)
    done = [row["result"] for row in rows]
    dates, code = (sorted({result[key] for result in done if result.get(key)}) for key in ("date", "revision"))
    versions = {", ".join(f"{k} {v}" for k, v in sorted(result.get("versions", {}).items())): None for result in done}
    made = [f"{len(done)} of {planned} cells"]
    made += [f"sparse.jsonl at commit {commit}"] if (commit := revision(out / "sparse.jsonl")) else []
    made += [f"cells that say when they ran: {dates[0]} to {dates[-1]}"] if dates else []
    made += [f"cells that say of which code: {', '.join(code)}"] if code else []
    origin = [f"Command: {command}.", f"Figures: {'; '.join(made)}.", f"Versions: {'; '.join(versions)}."]
    page = Environment(loader=PackageLoader("kgs.bench.study", ""), autoescape=True, trim_blocks=True)
    page.filters["parts"] = lambda text: re.split(r" (?=\[|or |\()", text)
    notes = page.get_template("notes.txt").render().splitlines()
    text = "\n".join([f"# {TITLE}", "", *(f"- {finding}" for finding in (*results, *origin)), "", ""])
    for title, table in tables.items():
        text += markdown_table(title, table.columns[1:], table.to_numpy().tolist(), table.columns[0])
    text += "\n".join(f"- {note}" for note in notes) + "\n"
    content: dict[str, Any] = {"title": TITLE, "findings": results, "origin": origin, "notes": notes, "tables": tables}
    content["pictures"] = {caption: b64encode((out / name).read_bytes()).decode() for name, caption in plots.items()}
    html = page.get_template("page.html.jinja").render(**content, version=__version__)
    (out / "sparse.md").write_text(text, encoding="utf-8")
    (out / "index.html").write_text(html, encoding="utf-8")
    return text
