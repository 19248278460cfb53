"""The guard: cells of a run beside stored ones of an earlier commit, for a change of the recipe or the code of fits.

Two fits from changed code are two draws, even with one seed. So the noise of a scene's difference is sqrt(2) times the
standard deviation between seeds, that of the default on the same scene. The verdict rests on the spread over scenes: a
scene may be ten times as noisy as the others, and the mean of scenes' noises would be its noise alone.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from .grid import finished_rows, read_rows
from .pairs import Difference, grouped, paired_difference
from .presets import AUTO
from .texts import counts, document, interval, signed, table_of

TITLE = "Has a change of the code changed the fits?"
STORED = Path(__file__).with_name("guard.jsonl")
LIMIT = 2.0  # noises; a larger change is marked
# what the mean of the scenes may lose where a change is kept: dB, LPIPS, and per cent of the time
MAX_LOSS = {"psnr": 0.1, "lpips": 0.003, "seconds": 10.0}
Row = Mapping[str, Any]
_NOTES = (
    "Change: to the stored cell of the same seed, in brackets its noise: sqrt(2) times the standard deviation of the "
    f"stored default between seeds. A change of more than {LIMIT:.0f} noises is marked with !. Three seeds say little "
    "of a standard deviation: where nothing but chance is at work, about one change of a scene in five is marked.",
    "The change of the mean has its 95 % interval from the spread over scenes (Student's t), and is marked where that "
    "is beyond 0.",
    "PSNR, and LPIPS with VGG16 and inputs in [0, 1], of held-out photos; seconds of processor time of initial points "
    "and fit, which only compare on one machine with the same load.",
    "By default seed 0 alone is fitted. `--seeds 0 1 2` also fits what stored cells tell the noise by; "
    "guard.jsonl then is what to store.",
)


class Measure(NamedTuple):
    """A number of a stored result; what a table calls it and its change, the decimals of both, and if in percent."""

    key: str
    head: str
    decimals: int
    head_of_change: str
    decimals_of_change: int
    percent: bool = False


MEASURES = (
    Measure("psnr", "PSNR [dB]", 2, "change of PSNR [dB]", 2),
    Measure("lpips", "LPIPS", 4, "change of LPIPS", 4),
    Measure("seconds", "seconds", 0, "change of seconds [%]", 1, percent=True),
    Measure("gaussians", "Gaussians", 0, "change of Gaussians [%]", 1, percent=True),
)


class Change(NamedTuple):
    """The mean of a measure of a scene, that of its changes, and the noise of this; NaN where there is none."""

    value: float
    difference: float
    noise: float

    @property
    def is_beyond_noise(self) -> bool:
        """Whether chance hardly explains it."""
        return abs(self.difference) > LIMIT * self.noise  # NaN is not

    def text(self, decimals: int) -> str:
        """As "-0.12 (0.03) !"."""
        if math.isnan(self.difference):
            return "-"
        noise = "" if math.isnan(self.noise) else f" ({self.noise:.{decimals}f})"
        return signed(self.difference, decimals) + noise + (" !" if self.is_beyond_noise else "")


def write_guard(rows: Sequence[Row], out: Path, command: str, planned: int, stored: Path = STORED) -> str:
    """Write guard.md, and guard.jsonl: the cells as they are stored.

    Args:
        rows: dicts of "cell" and "result", as the study keeps them, any part of the preset, at least one.
        out: the folder, made if it is not there.
        command: what makes this report again.
        planned: how many cells the preset has.
        stored: a guard.jsonl to compare with; where it lacks a cell, or is not there, the report has values alone.

    Returns what guard.md holds; DataError as of `read_rows`.
    """
    new = [_compact(row) for row in rows]
    old = finished_rows([row["cell"] for row in rows], stored)
    default = [row for row in read_rows(stored) if row["cell"]["method"] == AUTO]
    tables, verdict = _tables(_frame(new), _frame(old), _frame(default))
    sentences = [f"Command: {command}.", *verdict]
    sentences.append(f"{len(new)} of {planned} cells, {len(old)} of them with a stored one.")
    for name, some in (("These cells", new), ("Stored ones", old)):
        if some:
            sentences.append(f"{name}: {counts(_origin(row['result']) for row in some)}.")
    text = document(TITLE, [*sentences, *_NOTES], tables)
    out.mkdir(parents=True, exist_ok=True)
    (out / "guard.md").write_text(text.rstrip() + "\n", encoding="utf-8")
    kept = "".join(json.dumps(row, sort_keys=True) + "\n" for row in new)
    (out / "guard.jsonl").write_text(kept, encoding="utf-8")
    return text


def _compact(row: Row) -> dict[str, Any]:
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


def _frame(rows: Sequence[Row]) -> pd.DataFrame:
    """One line per stored cell, the last where it has two; "setting" is its scene with the number of views."""
    numbers = [measure.key for measure in MEASURES]
    cells = [row["cell"] | row["result"] for row in rows]
    frame = pd.DataFrame(cells, columns=["scene", "views", "method", "seed", *numbers])
    setting = frame.scene + ", " + frame.views.astype(str) + " views"
    frame = frame.astype(dict.fromkeys(numbers, float)).assign(setting=setting)
    return frame.drop_duplicates(["setting", "method", "seed"], keep="last")


def _tables(new: pd.DataFrame, old: pd.DataFrame, default: pd.DataFrame) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """A table of text for each method, and sentences on what is beyond noise."""
    tables = {}
    beyond = list[str]()
    single = list[Change]()
    of_default = dict[str, Difference]()
    for (method,), cells in grouped(new, "method"):
        lines = [{"scene": scene} for scene in cells.setting.unique()]
        mean_line = {"scene": f"mean of {len(lines)} scenes"}
        for measure in MEASURES:
            decimals = measure.decimals_of_change
            changes, mean = _changes(cells, old[old.method == method], default, measure)
            values = [*(change.value for change in changes), cells.groupby("setting")[measure.key].mean().mean()]
            texts = [*(change.text(decimals) for change in changes), _text_of_mean(mean, decimals)]
            for line, value, text in zip([*lines, mean_line], values, texts, strict=True):
                line[measure.head] = "-" if math.isnan(value) else f"{value:.{measure.decimals}f}"
                line[measure.head_of_change] = text
            if method == AUTO:
                of_default[measure.key] = mean
            single += [change for change in changes if not math.isnan(change.noise)]
            if _is_beyond_noise(mean):
                beyond.append(f"{method}: {measure.head} {texts[-1]}")
        tables[method] = table_of([*lines, mean_line] if len(lines) > 1 else lines)
    verdict = f"Beyond noise in the mean: {'; '.join(beyond)}." if beyond else "No mean has changed beyond noise."
    count = sum(change.is_beyond_noise for change in single)
    counted = f"{count} of {len(single)} changes of single scenes are beyond noise."
    return tables, [_answer(of_default), verdict, counted]


def _is_beyond_noise(mean: Difference) -> bool:
    """Whether 0 is outside of the interval over scenes."""
    low, high = mean.over_scenes
    return low > 0 or high < 0  # NaN is not


def _text_of_mean(mean: Difference, decimals: int) -> str:
    """As "-0.12 [-0.18, -0.06] !", the interval over scenes."""
    if not mean.pairs:
        return "-"
    limits = "" if math.isnan(mean.over_scenes[0]) else f" {interval(mean.over_scenes, decimals)}"
    return signed(mean.mean, decimals) + limits + (" !" if _is_beyond_noise(mean) else "")


def _answer(means: Mapping[str, Difference]) -> str:
    """Whether a change of the default is to be kept, by its mean over scenes: it gains and loses no more than it may.

    It gains where PSNR or LPIPS is better by its whole interval.
    """
    if all(math.isnan(change.over_scenes[0]) for change in means.values()):
        return "There is no verdict: it takes two scenes with stored fits of the default."
    better = {"psnr": means["psnr"].over_scenes[0] > 0, "lpips": means["lpips"].over_scenes[1] < 0}
    gains = [key for key, is_better in better.items() if is_better]
    losses = {key: means[key].mean for key in MAX_LOSS} | {"psnr": -means["psnr"].mean}
    lost = [key for key, loss in losses.items() if loss > MAX_LOSS[key]]
    if gains and not lost:
        return f"Yes: it gains in {' and '.join(gains)}, and loses no more than it may."
    why = f"it loses too much in {' and '.join(lost)}" if lost else "nothing is gained beyond noise"
    return f"No: {why}."


def _changes(
    new: pd.DataFrame, old: pd.DataFrame, default: pd.DataFrame, measure: Measure
) -> tuple[list[Change], Difference]:
    """Of one method: the change of each scene, in order of appearance, and that of their mean."""
    value, before, by_seed = (
        frame.pivot(index="seed", columns="setting", values=measure.key) for frame in (new, old, default)
    )
    change = 100 * (value / before - 1) if measure.percent else value - before
    change = change.dropna(axis="columns", how="all")
    noise = by_seed.std() * (100 / by_seed.mean() if measure.percent else 1.0)
    noise = noise.reindex(change.columns) * (2 / change.count()) ** 0.5
    scenes = pd.DataFrame({"value": value.mean(), "difference": change.mean(), "noise": noise})
    changes = [Change(*numbers) for numbers in scenes.loc[new.setting.unique()].itertuples(index=False)]
    return changes, paired_difference(change)


def _origin(result: Row) -> str:
    """As "at commit 1a2b3c4 of 2026-11-22, run on 2026-11-23, x86_64, 2 cores"."""
    commit = f"commit {result['revision']}" if result["revision"] else "no known commit"
    return f"at {commit}, run on {result['date'] or 'no known day'}, {result['machine']}"
