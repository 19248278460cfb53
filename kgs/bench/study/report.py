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
from .tables import COLUMNS, KEYS, QUALITY, cells_frame, difference, findings, sparse_tables

__all__ = ["write_report"]

TITLE = "Sparse views: DropGaussian on and off at equal first points"
NOTES = (
    "n counts seeds. The fits of a seed begin with the same points and see the views in the same order, so their "
    "differences are paired: mean [95 % interval of Student's t] (pairs). One pair has no interval.",
    "A mean over scenes weighs all scenes alike; its interval holds for these scenes and says nothing of others: it is "
    "from the variance between seeds, pooled over the scenes.",
    "Of many intervals one in twenty misses 0 by chance.",
    "SSIM is zero padded, LPIPS (VGG) has inputs that are not scaled to [-1, 1], both as published; sparse.csv and "
    "summary.csv have the usual variants too.",
    "CPU seconds are those of the training with its curve of test views; wall clock leaves the curve out, and depends "
    "on what else the machine did meanwhile. Peak memory is that of a process so far, which may have run other cells "
    "before.",
    "The paper's figures are means of 8 scenes after 10 000 steps, LLFF at 504x378 and Blender at 400x400, the best of "
    "five runs. They compare with ours in direction, not in level. Its figures without dropping are those that other "
    "papers print for 3DGS, so its differences are not at equal first points. It prints two values for the rate that "
    f"grows to 0.2 ({PAPER}) with three views: 20.76 dB in its comparisons, 20.56 dB in its table of rates; both are "
    "given.",
    "The paper does not define selection by gradient and distance, nor the L1 penalties: near, far, high and low "
    "gradient and the weights of L1 are our readings, and stand beside the same printed figure.",
)


def write_report(rows: Sequence[Mapping[str, Any]], out: Path, command: str, planned: int) -> str:
    """Write sparse.csv (a line per cell), summary.csv (a line per group), sparse.md, sparse.tex, plots and index.html.

    sparse.tex holds the tables, to be put into a document with the package booktabs. Plots and tables that have nothing
    to show are left out.

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
    plain = [*KEYS, "seed", *COLUMNS, "init.kind"]
    lines = frame[plain].assign(fit=[json.dumps(fit, sort_keys=True) for fit in frame.fit])
    lines.rename(columns=lambda name: name.replace(".", "_")).sort_index().to_csv(out / "sparse.csv", index=False)
    _summary(frame).to_csv(out / "summary.csv", index=False)
    tables, plots = sparse_tables(frame), write_plots(frame, out)
    results = findings(frame)
    origin = _origin(rows, out, command, planned)
    text = "\n".join([f"# {TITLE}", "", *(f"- {finding}" for finding in (*results, *origin)), "", ""])
    for title, lines in tables:
        text += markdown_table(title, lines.columns[1:], lines.to_numpy().tolist(), lines.columns[0])
    text += "\n".join(f"- {note}" for note in NOTES) + "\n"
    (out / "sparse.md").write_text(text, encoding="utf-8")
    (out / "sparse.tex").write_text(_latex([*results, *origin, *NOTES], tables), encoding="utf-8")
    pictures = {caption: b64encode((out / name).read_bytes()).decode() for name, caption in plots.items()}
    page = Environment(loader=PackageLoader("kgs.bench.study", ""), autoescape=True, trim_blocks=True)
    page.filters["break"] = lambda text: re.split(r" (?=\[|or |\()", text)
    content = {"title": TITLE, "findings": results, "origin": origin, "notes": NOTES, "tables": tables}
    html = page.get_template("page.html.jinja").render(**content, pictures=pictures, version=__version__)
    (out / "index.html").write_text(html, encoding="utf-8")
    return text


def _summary(frame: pd.DataFrame) -> pd.DataFrame:
    """The lines of summary.csv."""
    lines = []
    for group, cells in frame.sort_index().groupby(KEYS, sort=False):
        line = dict(zip(KEYS, group, strict=True)) | {"n": len(cells), "seeds": " ".join(map(str, sorted(cells.seed)))}
        for measure in COLUMNS:
            values, name = cells[measure], measure.replace(".", "_")
            line |= {f"{name}_mean": values.mean(), f"{name}_sd": values.std()}
            if measure.startswith("test."):
                line[f"{name}_best"] = values.min() if "lpips" in measure else values.max()
        same = frame[(frame.scene == line["scene"]) & (frame.views == line["views"])]
        pairs = {"off": ("method", OFF), "paper": ("method", PAPER), "sift": ("start", "sift")}
        for name, (key, base) in pairs.items():
            other = "start" if key == "method" else "method"
            for measure in QUALITY:
                gain = difference(same[same[other] == line[other]], measure, **{key: (line[key], base)})
                found = gain._asdict() if gain.pairs else {}
                for part in ("mean", "low", "high", "pairs"):
                    line[f"{measure.removeprefix('test.')}_over_{name}_{part}"] = found.get(part)
        lines.append(line)
    return pd.DataFrame(lines)


def _origin(rows: Sequence[Mapping[str, Any]], out: Path, command: str, planned: int) -> list[str]:
    """Where the figures are from: the command, the cells, their dates and commits, and the versions they ran with."""
    results = [row["result"] for row in rows]
    versions = {json.dumps(result.get("versions", {}), sort_keys=True): None for result in results}
    texts = [", ".join(f"{name} {version}" for name, version in json.loads(text).items()) for text in versions]
    kept, dates = revision(out / "sparse.jsonl"), sorted({r["date"] for r in results if r.get("date")})
    code = sorted({r["revision"] for r in results if r.get("revision")})
    made = [f"{len(rows)} of {planned} cells"]
    made += [f"sparse.jsonl at commit {kept}"] if kept else []
    made += [f"cells that say when they ran: {dates[0]} to {dates[-1]}"] if dates else []
    made += [f"cells that say of which code: {', '.join(code)}"] if code else []
    return [f"Command: {command}.", f"Figures: {'; '.join(made)}.", f"Versions: {'; '.join(texts)}."]


def _latex(sentences: Sequence[str], tables: Sequence[Any]) -> str:
    """The tables, the sentences as comments before them; a minus before a number is one."""
    parts = [f"% {sentence}\n" for sentence in sentences]
    for title, lines in tables:
        columns = "l" + "r" * (len(lines.columns) - 1)
        titles = {name: _escape(name) for name in lines.columns}
        table = lines.map(_escape).rename(columns=titles)
        text = table.style.hide(axis="index").to_latex(hrules=True, column_format=columns, caption=_escape(title))
        parts.append(f"{{\\scriptsize\\setlength{{\\tabcolsep}}{{3pt}}\n{text}}}\n\n")
    return "".join(parts)


def _escape(text: str) -> str:
    escaped = re.sub(r"([&%$#_{}])", r"\\\1", text.replace("\\", "/")).replace("~", r"\textasciitilde{}")
    escaped = re.sub(r"([<>])", r"$\1$", escaped).replace("^", r"\textasciicircum{}").replace("[", "{[}")
    return re.sub(r"(?<![\w-])-(?=\d)", "$-$", escaped)
