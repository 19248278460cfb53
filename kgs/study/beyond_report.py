"""The report of the views beyond the photos: two tables in Markdown, from any part of the cells."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from kgs.bench.output import mean_sd

from .beyond import CAMERAS, OUT, OUTER, ROOM
from .pairs import frame_of, grouped
from .texts import counts, document, table_of

TITLE = "Beyond the photos"
_NOTES = (
    "Mean (sd) over n seeds; PSNR in dB; LPIPS with VGG16, inputs in [0, 1]; seconds of wall time of a fit.",
    f"Synthetic: {CAMERAS} cameras on an ellipse around the middle of the training cameras, 1, 2 and 3 times as far "
    "out as these; all look at the middle of the scene. A pixel counts if a training view shows its surface: the point "
    "at its exact depth lies in that image, no farther than 1.05 times the exact depth of the nearest pixel there. For "
    "LPIPS the other pixels are the truth's. Share: of the pixels that count, at 1, 2 and 3. Inside: the test views, "
    "all pixels.",
    "Real: views are ordered by the distance of the camera's centre from the mean of all centres; the first ones are "
    f"trained on, the last {OUTER:.0%} of all photos are the outer views, all pixels. Seen: PSNR where, by the fit's "
    "own depth, two training views show the surface, and the share of these pixels.",
)
# What a table has of a scene: the columns of PSNR, or of a share, and of LPIPS.
_TEST = ("test.psnr", "test.lpips_vgg_unscaled")
_SYNTHETIC = {"inside": _TEST} | {f"{out} times out": (f"beyond.{out}.psnr", f"beyond.{out}.lpips") for out in OUT}
_REAL = {
    "outer views": _TEST,
    "seen": ("seen.psnr", None),
    "share": ("seen.share", None),
    "training views": ("train.psnr", "train.lpips_vgg_unscaled"),
}
_SHARES = [f"beyond.{out}.share" for out in OUT]
_NUMBERS = [column for columns in (*_SYNTHETIC.values(), *_REAL.values()) for column in columns if column is not None]
_NUMBERS = [*dict.fromkeys(_NUMBERS), *_SHARES, "gaussians", "wall_seconds"]


def write_beyond(rows: Sequence[Mapping[str, Any]], out: Path, command: str, planned: int) -> str:
    """Write beyond.md, and return what it holds.

    Args:
        rows: dicts of "cell" and "result", any part of the study, at least one.
        out: the folder, made if it is not there.
        command: what makes this report again.
        planned: how many cells the study has when it is done.
    """
    frame = frame_of(rows, _NUMBERS).astype(dict.fromkeys(_NUMBERS, float))
    commits = counts(row["result"].get("revision") or "of no known commit" for row in rows)
    sentences = [f"Command: {command}.", f"{len(rows)} of {planned} cells; by commit of kgs: {commits}.", *_NOTES]
    is_room = frame.scene == ROOM
    tables = {
        "Synthetic scene": _table(frame[is_room], _SYNTHETIC),
        "Real scenes": _table(frame[~is_room], _REAL),
    }
    text = document(TITLE, sentences, {title: table for title, table in tables.items() if len(table)})
    out.mkdir(parents=True, exist_ok=True)
    (out / "beyond.md").write_text(text.rstrip() + "\n", encoding="utf-8")
    return text


def _table(frame: pd.DataFrame, heads: Mapping[str, tuple[str, str | None]]) -> pd.DataFrame:
    """A line of text for each scene, number of views and method."""
    lines = []
    for (scene, views, method), cells in grouped(frame, "scene", "views", "method"):
        line = {"scene": f"{scene}, {views} views", "method": method, "n": str(len(cells))}
        for head, (psnr, lpips) in heads.items():
            line[head] = mean_sd(cells[psnr], 2)
            if lpips is not None and cells[lpips].count():
                line[head] += f"; {mean_sd(cells[lpips], 3)}"
        if scene == ROOM:
            line["share"] = ", ".join(f"{share:.2f}" for share in cells[_SHARES].iloc[0])
        line["Gaussians"] = mean_sd(cells.gaussians, 0)
        line["seconds"] = mean_sd(cells.wall_seconds, 0)
        lines.append(line)
    return table_of(lines)
