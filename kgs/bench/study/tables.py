"""The tables of the study, each figure with its n; the paper's printed figures stand beside ours."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from kgs.bench.output import mean_sd
from kgs.fit.metrics import MEASURES

from .presets import EQUAL_MEAN_RATE, FAMILIES, FIXED, MAIN, METHODS, OFF, PAPER
from .published import benchmark_of, published, published_difference
from .statistics import BEST_OF_5, Difference, noise_floor, paired_difference

KEYS = ("scene", "views", "start", "method")  # what cells have in common that differ in the seed alone
COLUMNS = [f"{part}.{name}" for part in ("test", "train") for name in MEASURES]
COLUMNS += ["init.points", "init.seconds", "gaussians", "wall_seconds", "cpu_seconds", "peak_rss_mb", "coadaptation"]
_OTHERS = ["init.kind", "curve", *(f"thresholds.{key}" for key in ("distance", "gaussians", "over"))]
_OTHERS += [f"protocol.{key}" for key in ("train", "test", "image_size")]
STARTS = ("sift", "random", "model-points", "full-model", "dense", "scene")
LPIPS = "test.lpips_vgg_unscaled"
QUALITY = {"test.psnr": 2, "test.ssim_zero_padded": 3, LPIPS: 3}  # and how many decimals
_COMPARISONS = {
    f"The paper's rule ({PAPER}) over no dropping (off)": ("method", PAPER, OFF),
    f"A fixed rate of the same mean ({FIXED}) over no dropping (off)": ("method", FIXED, OFF),
    f"The paper's rule over the fixed rate of the same mean ({FIXED})": ("method", PAPER, FIXED),
    f"Dense first points over those of SIFT, both with {PAPER}": ("start", "dense", "sift"),
}
Lines = list[dict[str, str]]


def cells_frame(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """One line per cell of rows of "cell" and "result", by scene: `KEYS`, "seed", "fit", numbers (NaN where absent).

    ValueError: no rows, or two cells that differ in nothing but their fits' settings or size.
    """
    if not rows:
        raise ValueError("rows: expected at least one cell, got none")
    cells = pd.DataFrame([row["cell"] for row in rows])[[*KEYS, "seed", "fit"]]
    results = pd.json_normalize([row["result"] for row in rows]).reindex(columns=COLUMNS + _OTHERS)
    numbers = results[COLUMNS].astype(float)
    for *group, seed in cells.loc[cells.duplicated([*KEYS, "seed"]), [*KEYS, "seed"]].to_numpy():
        raise ValueError(f"rows: expected one cell for each seed of {tuple(group)}, got two for {seed}")
    order = {name: k for k, name in enumerate([*cells.scene.unique(), *STARTS, *METHODS])}
    places = cells[[*KEYS]].assign(**{key: cells[key].map(order).fillna(len(order)) for key in KEYS if key != "views"})
    frame = pd.concat([cells, numbers.where(numbers.abs() < math.inf), results[_OTHERS]], axis=1)
    return frame.iloc[places.sort_values([*KEYS], kind="stable").index]


def each(frame: pd.DataFrame, *keys: str) -> Iterable[tuple[Any, pd.DataFrame]]:
    """The cells that share these fields, group by group in their order; the fields are a tuple."""
    return frame.groupby(list(keys), sort=False)


def wide(frame: pd.DataFrame, measure: str, **fixed: str) -> pd.DataFrame:
    """A measure of the cells with these fields: one row per seed, one column per group of the other fields."""
    for key, value in fixed.items():
        frame = frame[frame[key] == value]
    return frame.pivot(index="seed", columns=[key for key in KEYS if key not in fixed], values=measure)


def differences(frame: pd.DataFrame, key: str, value: str, base: str, measure: str = "test.psnr") -> pd.DataFrame:
    """Of cells that differ in one field alone, the method or the start: value less base, as `wide`."""
    if value == base or not {value, base} <= set(frame[key]):
        return pd.DataFrame()
    return wide(frame, measure, **{key: value}) - wide(frame, measure, **{key: base})


def difference(frame: pd.DataFrame, key: str, value: str, base: str, measure: str = "test.psnr") -> Difference:
    """The mean of `differences`, with its interval."""
    return paired_difference(differences(frame, key, value, base, measure))


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
        by_scene = {name.rpartition("/")[2]: difference(some, *pair) for (name,), some in each(cells, "scene")}
        scenes = [f"{name} {found.text()}" for name, found in by_scene.items() if found.pairs]
        if scenes:
            noise = noise_floor(differences(cells, *pair))
            spread = f", standard deviation of a pair: {noise.sd:.2f} dB" if noise.freedom else ""
            lpips = f" LPIPS (less is better): {cost.text(3)}." if cost.pairs else ""
            sentences.append(
                f"{what}: {gain.text()} dB of test PSNR (mean [95 % interval]; pairs: {gain.pairs}, scenes: "
                f"{len(scenes)}{spread}).{lpips} By scene: {'; '.join(scenes)} dB."
            )
    noise = noise_floor(wide(frame, "test.psnr"))
    if noise.freedom:
        single, three = (f"{noise.between_means(n):.2f} dB" for n in (1, 3))
        what = f"two single runs differ by up to {single}, and two means of three by up to {three}, 95 times in 100"
        sentences.append(f"Where nothing but the seed differs, {what} ({noise.groups} groups of runs).")
    return sentences


def sparse_tables(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """All tables that have a line, of text, by title; the main one first."""
    main = main_cells(frame)
    title = (
        "Test views: mean (sd) over n seeds; paired differences over off with their 95 % interval; the paper's figures "
        "are means of all its scenes in other sizes, best of five runs: not comparable in level, only in direction"
    )
    tables = {title: _methods(main), "Numbers of views": _views(frame), "First points": _starts(frame)}
    for _, cells in each(main, *KEYS[:3]):
        tables |= _ablations(cells) if set(cells.method) - set(MAIN) else {}
    title = "Noise between seeds under identical settings, pooled, and the difference that it makes 1 time in 20"
    tables |= {title: _noise(frame), "Cost, overfitting and co-adaptation: mean (sd) over n seeds": _cost(main)}
    tables |= {"Scenes, splits and settings": _protocol(frame)}
    return {title: pd.DataFrame(lines) for title, lines in tables.items() if lines}


def _settings(cells: pd.DataFrame) -> Lines:
    return [line for _, some in each(cells, *KEYS[:3]) for line in _compared(some, MAIN)]


def _methods(main: pd.DataFrame) -> Lines:
    found = main[main.method.isin(MAIN)]
    common = found[found.groupby("scene").method.transform("nunique") == found.method.nunique()]
    llff = common[(common.views == 3) & common.scene.map(lambda scene: benchmark_of(scene, 3) == "LLFF").astype(bool)]
    lines = _settings(main) + _compared(llff, MAIN, "LLFF scenes")
    return lines + (_compared(common, MAIN, "scenes") if len(llff) < len(common) else [])


def _views(frame: pd.DataFrame) -> Lines:
    dense = frame[frame.start == "dense"]
    several = dense[dense.groupby("scene").views.transform("nunique") > 1]
    means = each(several.sort_values("views", kind="stable"), "views")
    more = [line for (n,), cells in means for line in _compared(cells, MAIN, "scenes", f", {n} views")]
    return _settings(several) + more


def _ablations(cells: pd.DataFrame) -> dict[str, Lines]:
    where, benchmark, views = _setting(cells), _benchmark(cells), cells.views.iloc[0]
    found = set(cells.method)
    tables = {
        f"{title} ({where})": _compared(cells, (OFF, PAPER, *family), bases=(OFF, PAPER))
        for title, family in FAMILIES.items()
        if found & set(family)
    }
    lines = []
    for method, base in EQUAL_MEAN_RATE.items():
        if {method, base} <= found:
            line = {"": f"{method} over {base}", "PSNR [dB] (pairs)": _gain(cells, method, base)}
            lines.append(line | {"paper": published_difference(benchmark, views, method, base)})
    return tables | {f"A growing rate against a fixed one of the same mean ({where})": lines}


def _compared(
    cells: pd.DataFrame, methods: Iterable[str], kind: str = "", more: str = "", bases: Sequence[str] = (OFF,)
) -> Lines:
    """One line per method that all scenes have: of one setting, or (`kind`) by seed of the mean over several."""
    scenes, lines = cells.scene.unique(), Lines()
    if kind and len(scenes) < 2:
        return lines
    benchmark, views = _benchmark(cells), cells.views.iloc[0]
    names = ", ".join(scene.rpartition("/")[2] for scene in scenes)
    name = f"mean of {len(scenes)} {kind} ({names}){more}" if kind else _setting(cells)
    for method in methods:
        if cells[cells.method == method].scene.nunique() == len(scenes):
            psnr, ssim, lpips = (wide(cells, measure, method=method).dropna().mean(axis=1) for measure in QUALITY)
            line = ({"scene": name} if len(bases) == 1 else {}) | {"method": method} | _spread(psnr)
            line |= {f"over {base} [dB] (pairs)": _gain(cells, method, base) for base in bases}
            line |= {"SSIM": mean_sd(ssim, 3), "LPIPS": mean_sd(lpips, 3)}
            line["LPIPS over off"] = difference(cells, "method", method, OFF, LPIPS).text(3)
            line["paper: PSNR / SSIM / LPIPS"] = published(benchmark, views, method)
            line |= {f"paper: over {base}": published_difference(benchmark, views, method, base) for base in bases}
            lines.append(line)
    return lines


def _starts(frame: pd.DataFrame) -> Lines:
    lines = []
    for (scene, views, method), cells in each(frame[frame.method.isin(MAIN)], *KEYS[:2], "method"):
        same = frame[(frame.scene == scene) & (frame.views == views)]
        for (start,), some in each(cells, "start") if cells.start.nunique() > 1 else ():
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
    scenes = [(scene, "test.psnr", cells) for (scene,), cells in each(frame, "scene")]
    lines = []
    for name, measure, cells in [*(scenes if len(scenes) > 1 else []), *(("all cells", m, frame) for m in QUALITY)]:
        noise = noise_floor(wide(cells, measure))
        label = {"test.psnr": "PSNR [dB]", LPIPS: "LPIPS"}.get(measure, "SSIM")
        line = {"scene": name, "measure": label, "groups": str(noise.groups), "degrees of freedom": str(noise.freedom)}
        numbers = {"sd between seeds": noise.sd, "two single runs": noise.between_means(1)}
        numbers |= {f"two means of {n}": noise.between_means(n) for n in (3, 5)}
        numbers["best of 5 over the mean"] = BEST_OF_5 * noise.sd
        if noise.freedom:
            lines.append(line | {key: f"{value:.{QUALITY[measure] + 1}f}" for key, value in numbers.items()})
    return lines


def _cost(main: pd.DataFrame) -> Lines:
    main = main.assign(gap=main["train.psnr"] - main["test.psnr"], thousandths=1e3 * main.coadaptation)
    heads = {"PSNR, training less test views [dB]": ("gap", 2), "wall clock [s]": ("wall_seconds", 0)}
    heads |= {"CPU [s]": ("cpu_seconds", 0), "Gaussians": ("gaussians", 0), "peak memory [MiB]": ("peak_rss_mb", 0)}
    heads["co-adaptation [1e-3]"] = ("thousandths", 2)
    return [
        {"scene": _setting(cells), "method": method, "n": str(len(cells))}
        | {head: mean_sd(cells[measure], decimals) for head, (measure, decimals) in heads.items()}
        for (*_, method), cells in each(main, *KEYS)
    ]


def _protocol(frame: pd.DataFrame) -> Lines:
    """Sizes, splits, and the settings that all fits of a scene and number of views share."""
    lines = []
    for (scene, views), cells in each(frame.sort_values([*KEYS[:2]]), *KEYS[:2]):
        train, test, (height, width) = (cells[f"protocol.{key}"].iloc[0] for key in ("train", "test", "image_size"))
        shared = sorted(set.intersection(*({*fit.items()} for fit in cells.fit)))
        counts = {"training views": len(train), "test views": len(test), "cells": len(cells)}
        line = {"scene": f"{scene}, {views} views", **{key: str(value) for key, value in counts.items()}}
        fit = ", ".join(f"{key} {value}" for key, value in shared) or "-"
        lines.append(line | {"size": f"{width}x{height}", "what all fits share": fit})
    return lines


def _setting(cells: pd.DataFrame) -> str:
    return "{}, {} views, {}".format(*cells[[*KEYS[:3]]].iloc[0])


def _benchmark(cells: pd.DataFrame) -> str | None:
    """The paper's benchmark that all these cells are from."""
    found = {(benchmark_of(scene, views), views) for (scene, views), _ in each(cells, *KEYS[:2])}
    return found.pop()[0] if len(found) == 1 else None


def _spread(psnr: "pd.Series[float]") -> dict[str, str]:
    """How many, mean (sd) and best, in dB."""
    best = f"{psnr.max():.2f}" if psnr.count() else "-"
    return {"n": str(psnr.count()), "PSNR [dB]": mean_sd(psnr, 2), "best": best}


def _gain(cells: pd.DataFrame, value: str, base: str, key: str = "method") -> str:
    gain = difference(cells, key, value, base)
    return f"{gain.text()} ({gain.pairs})" if gain.pairs else "-"
