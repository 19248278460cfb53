"""The guard: cells of a run beside stored ones of an earlier commit, for a change of the recipe or the code of fits.

Two fits from changed code are two draws, even with one seed. So the noise of their difference is sqrt(2) times the
standard deviation between seeds, that of the default on the same scene.
"""

import json
import math
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from kgs.bench.output import markdown_table

from .grid import finished_rows, read_rows
from .presets import AUTO, name_of

TITLE = "Has a change of the code changed the fits?"
STORED = Path(__file__).with_name("guard.jsonl")
LIMIT = 2.0  # noises; a larger change is marked
Result = Mapping[str, Any]
_NOTES = (
    "Change: to the stored cell of the same seed, in brackets its noise: sqrt(2) times the standard deviation of the "
    f"stored default between seeds. A change of more than {LIMIT:.0f} noises is marked with !. Three seeds say little "
    "of a standard deviation: where nothing but chance is at work, about one change of a scene in five is marked, and "
    "one mean of eight scenes in sixteen. The standard error is that of the mean, from the spread over scenes.",
    "PSNR, and LPIPS with VGG16 and inputs in [0, 1], of held-out photos; seconds of processor time of initial points "
    "and fit, which only compare on one machine with the same load.",
    "By default seed 0 alone is fitted. `--seeds 0 1 2` also fits what stored cells tell the noise by; "
    "guard.jsonl then is what to store.",
)


class Measure(NamedTuple):
    """A number of a stored result, what a table calls it, its decimals, and whether its change is given in percent."""

    key: str
    head: str
    decimals: int
    percent: bool = False


MEASURES = (
    Measure("psnr", "PSNR [dB]", 2),
    Measure("lpips", "LPIPS", 4),
    Measure("seconds", "seconds", 0, True),
    Measure("gaussians", "Gaussians", 0, True),
)


class Change(NamedTuple):
    """The mean of a measure, that of its changes, and the noise of this; NaN where there is none."""

    value: float
    difference: float
    noise: float

    @property
    def is_beyond_noise(self) -> bool:
        """Whether chance hardly explains it."""
        return abs(self.difference) > LIMIT * self.noise  # NaN is not


def write_guard(rows: Sequence[Result], out: Path, command: str, planned: int, stored: Path = STORED) -> str:
    """Write guard.md, and guard.jsonl: the cells as they are stored.

    Args:
        rows: dicts of "cell" and "result", as the study keeps them, any part of the preset, at least one.
        out: the folder, made if it is not there.
        command: what makes this report again.
        planned: how many cells the preset has.
        stored: a guard.jsonl to compare with; where it lacks a cell, or is not there, the report has values alone.

    Returns what guard.md holds; ValueError as of `read_rows`.
    """
    new = [_compact(row) for row in rows]
    old = finished_rows([row["cell"] for row in rows], stored)
    tables, verdict = _tables(new, old, _spread(read_rows(stored)))
    lines = [f"Command: {command}.", *verdict]
    lines.append(f"{len(new)} of {planned} cells, {len(old)} of them with a stored one.")
    lines += [f"{name}: {_origin(some)}." for name, some in (("These cells", new), ("Stored ones", old)) if some]
    text = "\n".join([f"# {TITLE}", "", *(f"- {line}" for line in (*lines, *_NOTES)), "", ""]) + tables
    out.mkdir(parents=True, exist_ok=True)
    (out / "guard.md").write_text(text.rstrip() + "\n", encoding="utf-8")
    kept = "".join(json.dumps(row, sort_keys=True) + "\n" for row in new)
    (out / "guard.jsonl").write_text(kept, encoding="utf-8")
    return text


def _compact(row: Result) -> dict[str, Any]:
    """What is stored of a cell."""
    result = row["result"]
    kept = {
        "psnr": result["test"]["psnr"],
        "lpips": result["test"]["lpips_vgg_unscaled"],
        "seconds": round(result["init"]["seconds"] + result["cpu_seconds"], 2),
        "gaussians": result["gaussians"],
        "revision": result.get("revision"),
        "date": result.get("date"),
        "machine": result["versions"]["machine"],
    }
    return {"cell": row["cell"], "result": kept}


def _spread(stored: Iterable[Result]) -> dict[str, list[Result]]:
    """The stored results of the default, one for each seed, by scene."""
    spread: dict[str, list[Result]] = {}
    for row in stored:
        if row["cell"]["method"] == AUTO:
            spread.setdefault(_scene(row["cell"]), []).append(row["result"])
    return spread


def _tables(
    new: Sequence[Result], old: Sequence[Result], spread: Mapping[str, Sequence[Result]]
) -> tuple[str, list[str]]:
    """A table for each method, in Markdown, and sentences on what is beyond noise."""
    before = {name_of(row["cell"]): row["result"] for row in old}
    pairs: dict[str, dict[str, list[tuple[Result, Result | None]]]] = {}  # by method and scene
    for row in new:
        cell = row["cell"]
        of_scene = pairs.setdefault(cell["method"], {}).setdefault(_scene(cell), [])
        of_scene.append((row["result"], before.get(name_of(cell))))
    text = ""
    beyond = list[str]()
    single = list[Change]()
    for method, scenes in pairs.items():
        changes = {
            scene: [_change(some, spread.get(scene, ()), measure) for measure in MEASURES]
            for scene, some in scenes.items()
        }
        lines = [_line(scene, some) for scene, some in changes.items()]
        by_measure = [*zip(*changes.values(), strict=True)]
        means = [_mean_change(some) for some in by_measure]
        if len(changes) > 1:
            lines.append(_line(f"mean of {len(changes)} scenes", means))
            lines.append({"scene": "standard error"} | dict(map(_standard_error, by_measure, MEASURES)))
        single += [change for some in by_measure for change in some if not math.isnan(change.noise)]
        beyond += [
            f"{method}: {measure.head} {_change_text(mean, measure)}"
            for mean, measure in zip(means, MEASURES, strict=True)
            if mean.is_beyond_noise
        ]
        heads = [head for head in lines[0] if any(line.get(head, "-") != "-" for line in lines)]
        table = [[line.get(head, "-") for head in heads] for line in lines]
        text += markdown_table(method, heads[1:], table, heads[0])
    if not single:
        return text, ["There is nothing stored to tell a change from noise by."]
    count = sum(change.is_beyond_noise for change in single)
    verdict = f"Beyond noise in the mean: {'; '.join(beyond)}." if beyond else "No mean has changed beyond noise."
    return text, [verdict, f"{count} of {len(single)} changes of single scenes are beyond noise."]


def _change(pairs: Sequence[tuple[Result, Result | None]], spread: Iterable[Result], measure: Measure) -> Change:
    """Of one scene and method: results of its seeds, each with the stored one, and those that tell the noise."""
    key = measure.key
    values = [new[key] for new, _ in pairs if new[key] is not None]
    both = [(new[key], old[key]) for new, old in pairs if old and new[key] is not None and old[key] is not None]
    differences = [100 * (a / b - 1) if measure.percent else a - b for a, b in both]
    by_seed = [result[key] for result in spread if result[key] is not None]
    noise = math.nan
    if len(by_seed) > 1 and both:
        unit = 100 / statistics.fmean(by_seed) if measure.percent else 1.0
        noise = math.sqrt(2 / len(both)) * unit * statistics.stdev(by_seed)
    return Change(_mean(values), _mean(differences), noise)


def _mean_change(changes: Iterable[Change]) -> Change:
    """Over the scenes that have a change; its noise is known if that of each is."""
    some = [change for change in changes if not math.isnan(change.value)]
    changed = [change for change in some if not math.isnan(change.difference)]
    noise = math.hypot(*(change.noise for change in changed)) / len(changed) if changed else math.nan
    return Change(_mean([change.value for change in some]), _mean([change.difference for change in changed]), noise)


def _mean(values: Sequence[float]) -> float:
    return statistics.fmean(values) if values else math.nan


def _line(name: str, changes: Iterable[Change]) -> dict[str, str]:
    line = {"scene": name}
    for change, measure in zip(changes, MEASURES, strict=True):
        line[measure.head] = "-" if math.isnan(change.value) else f"{change.value:.{measure.decimals}f}"
        line[_head(measure)] = _change_text(change, measure)
    return line


def _standard_error(changes: Iterable[Change], measure: Measure) -> tuple[str, str]:
    """The head of its column, and that of the mean change over scenes."""
    some = [change.difference for change in changes if not math.isnan(change.difference)]
    if len(some) < 2:
        return _head(measure), "-"
    return _head(measure), f"{statistics.stdev(some) / math.sqrt(len(some)):.{_decimals(measure)}f}"


def _change_text(change: Change, measure: Measure) -> str:
    """As "-0.12 (0.03) !"."""
    if math.isnan(change.difference):
        return "-"
    decimals = _decimals(measure)
    text = f"{round(change.difference, decimals) + 0.0:+.{decimals}f}"  # + 0.0: no -0.00
    noise = "" if math.isnan(change.noise) else f" ({change.noise:.{decimals}f})"
    return text + noise + (" !" if change.is_beyond_noise else "")


def _head(measure: Measure) -> str:
    return f"change of {measure.head}{' [%]' if measure.percent else ''}"


def _decimals(measure: Measure) -> int:
    """Of its change."""
    return 1 if measure.percent else measure.decimals


def _scene(cell: Mapping[str, Any]) -> str:
    return f"{cell['scene']}, {cell['views']} views"


def _origin(rows: Iterable[Result]) -> str:
    """As "24 at commit 1a2b3c4 of 2026-11-22, run on 2026-11-23, x86_64, 2 cores", the most frequent first."""
    results = [row["result"] for row in rows]
    origins = Counter(
        f"at {'commit ' + result['revision'] if result['revision'] else 'no known commit'}, "
        f"run on {result['date'] or 'no known day'}, {result['machine']}"
        for result in results
    )
    return "; ".join(f"{count} {origin}" for origin, count in origins.most_common())
