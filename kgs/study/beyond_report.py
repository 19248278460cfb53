"""The report of the views beyond the photos: two tables in Markdown, from any part of the cells."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from kgs.bench.output import markdown_table, mean_sd

from .beyond import CAMERAS, OUT, OUTER, WORLDS

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


def write_beyond(rows: Sequence[Mapping[str, Any]], out: Path, command: str, planned: int) -> str:
    """Write beyond.md, and return what it holds.

    Args:
        rows: dicts of "cell" and "result", any part of the study, at least one.
        out: the folder, made if it is not there.
        command: what makes this report again.
        planned: how many cells the study has when it is done.
    """
    revisions = Counter(row["result"].get("revision") or "of no known commit" for row in rows)
    told = "; ".join(f"{count} {revision}" for revision, count in revisions.most_common())
    lines = [f"- Command: {command}.", f"- {len(rows)} of {planned} cells; by commit of kgs: {told}."]
    text = "\n".join([f"# {TITLE}", "", *lines, *(f"- {note}" for note in _NOTES), "", ""])
    synthetic = [_synthetic(*group) for group in _groups(rows) if group[0] in WORLDS]
    real = [_real(*group) for group in _groups(rows) if group[0] not in WORLDS]
    for title, table in (("Synthetic scenes", synthetic), ("Real scenes", real)):
        if table:
            text += markdown_table(title, [*table[0]][1:], [list(line.values()) for line in table], "scene")
    out.mkdir(parents=True, exist_ok=True)
    (out / "beyond.md").write_text(text.rstrip() + "\n", encoding="utf-8")
    return text


def _groups(rows: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, int, str, list[Mapping[str, Any]]]]:
    """Scene, views, method, and the results of its seeds, in order of appearance."""
    groups: dict[tuple[str, int, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        cell = row["cell"]
        groups.setdefault((cell["scene"], cell["views"], cell["method"]), []).append(row["result"])
    for key, results in groups.items():
        yield *key, results


def _synthetic(scene: str, views: int, method: str, results: list[Mapping[str, Any]]) -> dict[str, str]:
    line = _start(scene, views, method, results) | {"inside": _pair(results, "test")}
    for out in OUT:
        some = [result["beyond"][str(out)] for result in results]
        line[f"{out} times out"] = _of(some, "psnr", 2) + _beside(_of(some, "lpips", 3))
    shares = (f"{results[0]['beyond'][str(out)]['share']:.2f}" for out in OUT)
    return line | {"share": ", ".join(shares)} | _end(results)


def _real(scene: str, views: int, method: str, results: list[Mapping[str, Any]]) -> dict[str, str]:
    seen = [result["seen"] for result in results]
    line = _start(scene, views, method, results)
    line["outer views"] = _pair(results, "test")
    line["seen"] = _of(seen, "psnr", 2)
    line["share"] = _of(seen, "share", 2)
    line["training views"] = _pair(results, "train")
    return line | _end(results)


def _start(scene: str, views: int, method: str, results: Sequence[object]) -> dict[str, str]:
    return {"scene": f"{scene}, {views} views", "method": method, "n": str(len(results))}


def _end(results: list[Mapping[str, Any]]) -> dict[str, str]:
    return {"Gaussians": _of(results, "gaussians", 0), "seconds": _of(results, "wall_seconds", 0)}


def _pair(results: list[Mapping[str, Any]], part: str) -> str:
    """PSNR, and LPIPS if it was measured."""
    some = [result[part] for result in results]
    return _of(some, "psnr", 2) + _beside(_of(some, "lpips_vgg_unscaled", 3))


def _beside(text: str) -> str:
    return "" if text == "-" else f"; {text}"


def _of(results: Iterable[Mapping[str, Any]], key: str, decimals: int) -> str:
    return mean_sd((math.nan if result[key] is None else result[key] for result in results), decimals)
