"""The report of the study of sparse views: CSV, Markdown, LaTeX, plots and a page, from any part of its cells."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from kgs.fit.metrics import MEASURES

from .output import latex_escape, latex_table, markdown_table, write_csv
from .published import PAPER
from .sparse_groups import OFF, Groups, over
from .sparse_page import sparse_page
from .sparse_plots import write_plots
from .sparse_tables import QUALITY, Table, headline, sparse_tables
from .statistics import by_seed, group_cells, paired_difference, summarize

__all__ = ["write_report"]

TITLE = "Sparse views: DropGaussian on and off at equal first points"
COLUMNS = (
    *(f"{part}.{name}" for part in ("test", "train") for name in MEASURES),
    *("init.points", "init.seconds", "gaussians", "wall_seconds", "cpu_seconds", "peak_rss_mb", "coadaptation"),
)
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
    """Write sparse.csv (a line a cell), summary.csv (a line a group), sparse.md, sparse.tex, plots and index.html.

    sparse.tex is the body of a document in landscape, or part of one, and needs no package. Plots and tables that have
    nothing to show are left out.

    Args:
        rows: dicts of "cell" and "result", any part of the study.
        out: the folder, made if it is not there.
        command: what makes this report again.
        planned: how many cells the study has when it is done.

    Returns:
        What sparse.md holds.

    Raises:
        ValueError: no rows, or two cells that differ in nothing but the settings of their fits.
    """
    if not rows:
        raise ValueError("rows: expected at least one cell, got none")
    groups = group_cells(rows)
    out.mkdir(parents=True, exist_ok=True)
    write_csv(out / "sparse.csv", [_flat(row) for row in rows])
    write_csv(out / "summary.csv", _summaries(groups))
    tables = [*sparse_tables(groups), _protocol(rows)]
    findings = [*headline(groups), _extent(rows, command, planned)]
    text = "\n".join([f"# {TITLE}", "", *(f"- {finding}" for finding in findings), "", ""])
    text += "".join(markdown_table(*table) for table in tables)
    text += "\n".join(f"- {note}" for note in NOTES) + "\n"
    (out / "sparse.md").write_text(text, encoding="utf-8")
    (out / "sparse.tex").write_text(_latex(findings, tables), encoding="utf-8")
    page = sparse_page(TITLE, findings, NOTES, tables, write_plots(groups, out))
    (out / "index.html").write_text(page, encoding="utf-8")
    return text


def _latex(findings: Sequence[str], tables: Sequence[Table]) -> str:
    sentences = [rf"\item {latex_escape(sentence)}" for sentence in (*findings, *NOTES)]
    items = "\n".join([r"\begin{itemize}", *sentences, r"\end{itemize}", "", ""])
    return items + "".join(latex_table(*table) for table in tables)


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """A line of sparse.csv; what a cell lacks is empty."""
    cell, result = row["cell"], row["result"]
    numbers = {measure: _number(result, measure) for measure in COLUMNS}
    return {
        **{key: cell[key] for key in ("scene", "views", "start", "method", "seed")},
        **{measure.replace(".", "_"): number for measure, number in numbers.items()},
        "init_kind": result["init"]["kind"],
        "fit": json.dumps(cell["fit"], sort_keys=True),
    }


def _number(result: Mapping[str, Any], measure: str) -> float | None:
    return by_seed({0: result}, measure).get(0)


def _summaries(groups: Groups) -> list[dict[str, Any]]:
    """The lines of summary.csv."""
    lines = []
    for group, results in groups.items():
        line: dict[str, Any] = {**group._asdict(), "n": len(results), "seeds": " ".join(map(str, sorted(results)))}
        for measure in COLUMNS:
            summary = summarize(by_seed(results, measure).values(), lower_is_better="lpips" in measure)
            for key in ("mean", "sd", "best") if measure.startswith("test.") else ("mean", "sd"):
                line[f"{measure.replace('.', '_')}_{key}"] = getattr(summary, key, None)
        for name, base in (("off", {"method": OFF}), ("paper", {"method": PAPER}), ("sift", {"start": "sift"})):
            is_other = group._replace(**base) != group  # type: ignore[arg-type]  # two fields that are str
            for measure in QUALITY:
                difference = paired_difference([over(groups, group, measure, **base)]) if is_other else None
                for key in ("mean", "low", "high", "pairs"):
                    line[f"{measure.removeprefix('test.')}_over_{name}_{key}"] = getattr(difference, key, None)
        lines.append(line)
    return lines


def _protocol(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Sizes, splits, and the settings that all fits of a scene and number of views share."""
    settings: dict[tuple[str, int], list[Mapping[str, Any]]] = {}
    for row in rows:
        settings.setdefault((row["cell"]["scene"], row["cell"]["views"]), []).append(row)
    lines = []
    for (scene, views), some in sorted(settings.items()):
        protocol, fits = some[0]["result"]["protocol"], [row["cell"]["fit"] for row in some]
        height, width = protocol["image_size"]
        shared = {key: value for key, value in fits[0].items() if all(fit.get(key) == value for fit in fits)}
        fit = ", ".join(f"{key} {value}" for key, value in sorted(shared.items()))
        counts = (len(protocol["train"]), len(protocol["test"]), len(some))
        lines.append([f"{scene}, {views} views", *map(str, counts), f"{width}x{height}", fit or "-"])
    columns = ("training views", "test views", "cells", "size", "what all fits share")
    return Table("Scenes, splits and settings", columns, lines, "scene")


def _extent(rows: Sequence[Mapping[str, Any]], command: str, planned: int) -> str:
    versions = {json.dumps(row["result"].get("versions", {}), sort_keys=True): None for row in rows}
    texts = [", ".join(f"{name} {version}" for name, version in json.loads(text).items()) for text in versions]
    return f"Command: {command}; cells: {len(rows)} of {planned}; {'; '.join(texts)}."
