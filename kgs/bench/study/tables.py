"""The tables of the study, each figure with its n; the paper's printed figures stand beside ours."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import pandas as pd
from scipy import stats

from kgs.bench.output import mean_sd
from kgs.fit.metrics import MEASURES

from .presets import EQUAL_MEAN_RATE, FAMILIES, FIXED, MAIN, METHODS, OFF, PAPER
from .published import benchmark_of, published, published_difference

KEYS = ("scene", "views", "start", "method")  # what cells have in common that differ in the seed alone
COLUMNS = [f"{part}.{name}" for part in ("test", "train") for name in MEASURES]
COLUMNS += ["init.points", "init.seconds", "gaussians", "wall_seconds", "cpu_seconds", "peak_rss_mb", "coadaptation"]
_OTHERS = ["init.kind", "curve", *(f"thresholds.{key}" for key in ("distance", "gaussians", "over"))]
_OTHERS += [f"protocol.{key}" for key in ("train", "test", "image_size")]
STARTS = ("sift", "random", "model-points", "full-model", "dense", "scene")
LPIPS = "test.lpips_vgg_unscaled"
QUALITY = {"test.psnr": "PSNR [dB]", "test.ssim_zero_padded": "SSIM", LPIPS: "LPIPS"}
_COST = {"PSNR, training less test views [dB]": "gap", "wall clock [s]": "wall_seconds", "CPU [s]": "cpu_seconds"}
_COST |= {"Gaussians": "gaussians", "peak memory [MiB]": "peak_rss_mb", "co-adaptation [1e-3]": "thousandths"}
_COMPARISONS = {
    f"The paper's rule ({PAPER}) over no dropping (off)": ("method", PAPER, OFF),
    f"A fixed rate of the same mean ({FIXED}) over no dropping (off)": ("method", FIXED, OFF),
    f"The paper's rule over the fixed rate of the same mean ({FIXED})": ("method", PAPER, FIXED),
    f"Dense first points over those of SIFT, both with {PAPER}": ("start", "dense", "sift"),
}
_TITLE = """Test views: mean (sd) over n seeds; paired differences over off with their 95 % interval; the paper's \
figures are means of all its scenes in other sizes, best of five runs: not comparable in level, only in direction"""
BEST_OF_5 = 1.163  # how far the best of five runs lies over the mean on average, in standard deviations
Lines = list[dict[str, str]]


class Difference(NamedTuple):
    """How many pairs, the mean difference, its 95 % interval and the standard deviation of a pair, NaN if unknown."""

    pairs: int
    mean: float
    low: float
    high: float
    sd: float = math.nan

    def text(self, decimals: int = 2) -> str:
        """As "+0.31 [+0.10, +0.52]"; "+0.31" without an interval, "-" without pairs."""
        if not self.pairs:
            return "-"
        mean, low, high = (f"{round(value, decimals) + 0.0:+.{decimals}f}" for value in self[1:4])  # + 0.0: no -0.00
        return mean if math.isnan(self.low) else f"{mean} [{low}, {high}]"


class Noise(NamedTuple):
    """The standard deviation between seeds under equal settings, its degrees of freedom, and from how many groups."""

    sd: float
    freedom: int
    groups: int

    def between_means(self, n: int) -> float:
        """What two means of n seeds differ by at most, 95 times in 100, if the settings do nothing (Student's t)."""
        return float(stats.t.ppf(0.975, self.freedom)) * math.sqrt(2 / n) * self.sd


def noise_floor(groups: pd.DataFrame) -> Noise:
    """The root of the groups' mean variance, weighted by degrees of freedom; NaN if no group has two numbers."""
    freedom = (groups.count() - 1).clip(lower=0)
    total = int(freedom.sum())
    variance = float((groups.var() * freedom).sum()) / total if total else math.nan
    return Noise(math.sqrt(variance), total, int((freedom > 0).sum()))


def paired_difference(differences: pd.DataFrame) -> Difference:
    """The mean over scenes of each scene's mean difference, with its 95 % interval.

    The scenes are taken as given, the seeds as drawn: Student's t with the variance between seeds pooled over scenes.
    """
    counts = differences.count()[differences.count() > 0]
    mean, noise = float(differences.mean().mean()), noise_floor(differences)
    half = float(stats.t.ppf(0.975, noise.freedom)) * (noise.sd * math.sqrt((1 / counts).sum()) / max(1, len(counts)))
    return Difference(int(counts.sum()), mean, mean - half, mean + half, noise.sd)


def cells_frame(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """One line per cell, by scene; ValueError: no rows, or two that differ in the fit's settings or size alone."""
    if not rows:
        raise ValueError("rows: expected at least one cell, got none")
    cells = pd.DataFrame([row["cell"] for row in rows])[[*KEYS, "seed", "fit"]]
    results = pd.json_normalize([row["result"] for row in rows]).reindex(columns=COLUMNS + _OTHERS)
    results[COLUMNS] = results[COLUMNS].astype(float).where(lambda numbers: numbers.abs() < math.inf)
    for *group, seed in cells.loc[cells.duplicated([*KEYS, "seed"]), [*KEYS, "seed"]].to_numpy():
        raise ValueError(f"rows: expected one cell for each seed of {tuple(group)}, got two for {seed}")
    order = {name: k for k, name in enumerate([*cells.scene.unique(), *STARTS, *METHODS])}
    places = cells[[*KEYS]].assign(**{key: cells[key].map(order).fillna(len(order)) for key in KEYS if key != "views"})
    return cells.join(results).iloc[places.sort_values([*KEYS], kind="stable").index]


def grouped(frame: pd.DataFrame, *keys: str) -> Iterable[tuple[Any, pd.DataFrame]]:
    """The cells that share these fields, group by group in their order; the fields are a tuple."""
    return frame.groupby(list(keys), sort=False)


def wide(frame: pd.DataFrame, measure: str, **fixed: str) -> pd.DataFrame:
    """A measure of the cells with these fields: one row per seed, one column per group of the other fields."""
    for key, value in fixed.items():
        frame = frame[frame[key] == value]
    return frame.pivot(index="seed", columns=[key for key in KEYS if key not in fixed], values=measure)


def difference(frame: pd.DataFrame, key: str, value: str, base: str, measure: str = "test.psnr") -> Difference:
    """Of cells that differ in one field alone, the method or the start: the mean of value less base."""
    if value == base or not {value, base} <= set(frame[key]):
        return paired_difference(pd.DataFrame())
    return paired_difference(wide(frame, measure, **{key: value}) - wide(frame, measure, **{key: base}))


def main_cells(frame: pd.DataFrame, starts: Sequence[str] = ("dense",)) -> pd.DataFrame:
    """The cells of each scene's main protocol: the fewest views that it has from dense first points."""
    fewest = frame[frame.start == "dense"].groupby("scene").views.min()
    return frame[(frame.views == frame.scene.map(fewest)) & frame.start.isin(starts)]


def findings(frame: pd.DataFrame) -> list[str]:
    """The results in sentences, each with its pairs, scenes, spread and interval; none of cells without pairs."""
    main, sentences = main_cells(frame, STARTS), []
    for what, pair in _COMPARISONS.items():
        cells = main[main.start == "dense"] if pair[0] == "method" else main[main.method == PAPER]
        gain, cost = difference(cells, *pair), difference(cells, *pair, LPIPS)
        by_scene = {name.rpartition("/")[2]: difference(some, *pair) for (name,), some in grouped(cells, "scene")}
        scenes = [f"{name} {found.text()}" for name, found in by_scene.items() if found.pairs]
        if scenes:
            spread = "" if math.isnan(gain.sd) else f", standard deviation of a pair: {gain.sd:.2f} dB"
            lpips = f" LPIPS (less is better): {cost.text(3)}." if cost.pairs else ""
            counts = f"pairs: {gain.pairs}, scenes: {len(scenes)}{spread}"
            found = f"{gain.text()} dB of test PSNR (mean [95 % interval]; {counts}).{lpips}"
            sentences.append(f"{what}: {found} By scene: {'; '.join(scenes)} dB.")
    if (noise := noise_floor(wide(frame, "test.psnr"))).freedom:
        single, three = (f"{noise.between_means(n):.2f} dB" for n in (1, 3))
        what = f"two single runs differ by up to {single}, and two means of three by up to {three}, 95 times in 100"
        sentences.append(f"Where nothing but the seed differs, {what} ({noise.groups} groups of runs).")
    return sentences


def sparse_tables(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """All tables that have a line, of text, by title; the main one first."""
    main, dense = main_cells(frame), frame[frame.start == "dense"]
    several = dense[dense.groupby("scene").views.transform("nunique") > 1]
    by_views = _settings(several)
    for (n,), cells in grouped(several.sort_values("views", kind="stable"), "views"):
        by_views += _compared(cells, MAIN, f"mean of {{}} scenes ({{}}), {n} views")
    tables = {_TITLE: _methods(main), "Numbers of views": by_views, "First points": _starts(frame)}
    for _, cells in grouped(main, *KEYS[:3]):
        where, found = _setting(cells), set(cells.method)
        if found <= set(MAIN):
            continue
        for title, family in FAMILIES.items():
            if found & set(family):
                tables[f"{title} ({where})"] = _compared(cells, (OFF, PAPER, *family), bases=(OFF, PAPER))
        tables[f"A growing rate against a fixed one of the same mean ({where})"] = [
            {"": f"{method} over {base}", "PSNR [dB] (pairs)": _gain(cells, method, base)}
            | {"paper": published_difference(*_benchmark(cells), method, base)}
            for method, base in EQUAL_MEAN_RATE.items()
            if {method, base} <= found
        ]
    title = "Noise between seeds under identical settings, pooled, and the difference that it makes 1 time in 20"
    tables[title] = _noise(frame)
    main = main.assign(gap=main["train.psnr"] - main["test.psnr"], thousandths=1e3 * main.coadaptation)
    tables["Cost, overfitting and co-adaptation: mean (sd) over n seeds"] = [
        {"scene": _setting(cells), "method": method, "n": str(len(cells))}
        | {head: mean_sd(cells[key], 2 if key in ("gap", "thousandths") else 0) for head, key in _COST.items()}
        for (*_, method), cells in grouped(main, *KEYS)
    ]
    tables["Scenes, splits and settings"] = protocol = Lines()
    for (scene, views), cells in grouped(frame.sort_values([*KEYS[:2]]), *KEYS[:2]):
        train, test, (height, width) = (cells[f"protocol.{key}"].iloc[0] for key in ("train", "test", "image_size"))
        shared = sorted(set.intersection(*({*fit.items()} for fit in cells.fit)))
        line = {"scene": f"{scene}, {views} views", "training views": str(len(train)), "test views": str(len(test))}
        line |= {"cells": str(len(cells)), "size": f"{width}x{height}"}
        protocol.append(line | {"what all fits share": ", ".join(f"{key} {value}" for key, value in shared) or "-"})
    return {title: pd.DataFrame(lines) for title, lines in tables.items() if lines}


def _settings(cells: pd.DataFrame) -> Lines:
    return [line for _, some in grouped(cells, *KEYS[:3]) for line in _compared(some, MAIN)]


def _methods(main: pd.DataFrame) -> Lines:
    found = main[main.method.isin(MAIN)]
    common = found[found.groupby("scene").method.transform("nunique") == found.method.nunique()]
    llff = common[(common.views == 3) & common.scene.map(lambda scene: benchmark_of(scene, 3) == "LLFF").astype(bool)]
    lines = _settings(main) + _compared(llff, MAIN, "mean of {} LLFF scenes ({})")
    return lines + (_compared(common, MAIN, "mean of {} scenes ({})") if len(llff) < len(common) else [])


def _compared(cells: pd.DataFrame, methods: Iterable[str], mean: str = "", bases: Sequence[str] = (OFF,)) -> Lines:
    """One line per method that all scenes have: of one setting, or (`mean`, their name) by seed over several."""
    scenes, lines = cells.scene.unique(), Lines()
    if mean and len(scenes) < 2:
        return lines
    benchmark, names = _benchmark(cells), ", ".join(scene.rpartition("/")[2] for scene in scenes)
    name = mean.format(len(scenes), names) if mean else _setting(cells)
    for method in methods:
        if cells[cells.method == method].scene.nunique() == len(scenes):
            psnr, ssim, lpips = (wide(cells, measure, method=method).dropna().mean(axis=1) for measure in QUALITY)
            line = ({"scene": name} if len(bases) == 1 else {}) | {"method": method} | _spread(psnr)
            line |= {f"over {base} [dB] (pairs)": _gain(cells, method, base) for base in bases}
            line |= {"SSIM": mean_sd(ssim, 3), "LPIPS": mean_sd(lpips, 3)}
            line["LPIPS over off"] = difference(cells, "method", method, OFF, LPIPS).text(3)
            line["paper: PSNR / SSIM / LPIPS"] = published(*benchmark, method)
            lines.append(line | {f"paper: over {b}": published_difference(*benchmark, method, b) for b in bases})
    return lines


def _starts(frame: pd.DataFrame) -> Lines:
    lines = []
    for (scene, views, method), cells in grouped(frame[frame.method.isin(MAIN)], *KEYS[:2], "method"):
        same = frame[(frame.scene == scene) & (frame.views == views)]
        for (start,), some in grouped(cells, "start") if cells.start.nunique() > 1 else ():
            gave = sorted({*some["init.kind"]} - {start}) if start in ("dense", "sift") else []
            note = " (sees test views)" if start in ("model-points", "full-model") else ""
            line = {"scene": f"{scene}, {views} views", "method": method}
            line["start"] = f"{start} (gave {', '.join(gave)})" if gave else start + note
            line |= _spread(some["test.psnr"])
            line |= {"first points": mean_sd(some["init.points"], 0), "their CPU [s]": mean_sd(some["init.seconds"], 0)}
            line["over sift [dB] (pairs)"] = _gain(cells, start, "sift", "start")
            line["over off, same start [dB] (pairs)"] = _gain(same[same.start == start], method, OFF)
            lines.append(line)
    return lines


def _noise(frame: pd.DataFrame) -> Lines:
    scenes = [(scene, "test.psnr", cells) for (scene,), cells in grouped(frame, "scene")]
    lines = []
    for name, measure, cells in [*(scenes if len(scenes) > 1 else []), *(("all cells", m, frame) for m in QUALITY)]:
        noise = noise_floor(wide(cells, measure))
        label, decimals = QUALITY[measure], 3 if measure == "test.psnr" else 4
        line = {"scene": name, "measure": label, "groups": str(noise.groups), "degrees of freedom": str(noise.freedom)}
        numbers = {"sd between seeds": noise.sd, "two single runs": noise.between_means(1)}
        numbers |= {f"two means of {n}": noise.between_means(n) for n in (3, 5)}
        numbers["best of 5 over the mean"] = BEST_OF_5 * noise.sd
        lines += [line | {key: f"{value:.{decimals}f}" for key, value in numbers.items()}] if noise.freedom else []
    return lines


def _setting(cells: pd.DataFrame) -> str:
    return "{}, {} views, {}".format(*cells[[*KEYS[:3]]].iloc[0])


def _benchmark(cells: pd.DataFrame) -> tuple[str | None, int]:
    """The paper's benchmark that all these cells are from, and its number of views."""
    found = {(benchmark_of(scene, views), views) for (scene, views), _ in grouped(cells, *KEYS[:2])}
    return found.pop() if len(found) == 1 else (None, 0)


def _spread(psnr: "pd.Series[float]") -> dict[str, str]:
    return {"n": str(psnr.count()), "PSNR [dB]": mean_sd(psnr, 2), "best": f"{psnr.max():.2f}" if psnr.count() else "-"}


def _gain(cells: pd.DataFrame, value: str, base: str, key: str = "method") -> str:
    gain = difference(cells, key, value, base)
    return f"{gain.text()} ({gain.pairs})" if gain.pairs else "-"
