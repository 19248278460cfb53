"""The tables of the study, each figure with its n; the paper's printed figures stand beside ours."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import pandas as pd

from kgs.bench.output import mean_sd
from kgs.fit.metrics import MEASURES

from .presets import EQUAL_MEAN_RATE, FAMILIES, FIXED, MAIN, METHODS, OFF, PAPER
from .published import benchmark_of, published, published_differences
from .statistics import Difference, noise_floor, paired_difference

__all__ = ["COLUMNS", "KEYS", "LPIPS", "QUALITY", "Table", "cells_frame", "difference", "findings", "main_cells",
           "sparse_tables", "wide"]  # fmt: skip

KEYS = ["scene", "views", "start", "method"]  # what cells have in common that differ in the seed alone
COLUMNS = (
    *(f"{part}.{name}" for part in ("test", "train") for name in MEASURES),
    *("init.points", "init.seconds", "gaussians", "wall_seconds", "cpu_seconds", "peak_rss_mb", "coadaptation"),
)
STARTS = ("sift", "random", "model-points", "full-model", "dense", "scene")
LPIPS = "test.lpips_vgg_unscaled"
QUALITY = {"test.psnr": 2, "test.ssim_zero_padded": 3, LPIPS: 3}  # and how many decimals


class Table(NamedTuple):
    """One table: its title, and its lines as text."""

    title: str
    lines: pd.DataFrame


def cells_frame(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """One line per cell, scene by scene in the order of the rows: `KEYS`, "seed", "fit", numbers (NaN where absent).

    Args:
        rows: dicts of "cell" and "result".

    Raises:
        ValueError: no rows, or two cells that differ in nothing but their fits' settings or size: those belong in two
            reports.
    """
    if not rows:
        raise ValueError("rows: expected at least one cell, got none")
    cells = pd.DataFrame([dict(row["cell"]) for row in rows])[[*KEYS, "seed", "fit"]]
    results = pd.json_normalize([dict(row["result"]) for row in rows])
    numbers = results.reindex(columns=list(COLUMNS)).astype(float).replace([float("inf"), float("-inf")], float("nan"))
    others = ["init.kind", "curve", *(f"thresholds.{key}" for key in ("distance", "gaussians", "over"))]
    others += [f"protocol.{key}" for key in ("train", "test", "image_size")]
    frame = pd.concat([cells, numbers, results.reindex(columns=others)], axis=1)
    if (twice := frame.duplicated([*KEYS, "seed"])).any():
        group = tuple(frame.loc[twice.idxmax(), [*KEYS, "seed"]])
        raise ValueError(f"rows: expected one cell for each seed of {group[:-1]}, got two for {group[-1]}")
    scenes, known = {name: k for k, name in enumerate(frame.scene.unique())}, dict.fromkeys([*STARTS, *METHODS])
    order = {**scenes, **{name: k for k, name in enumerate(known)}}
    return frame.sort_values(KEYS, key=lambda c: c if c.name == "views" else c.map(order).fillna(99), kind="stable")


def wide(frame: pd.DataFrame, measure: str, **fixed: str) -> pd.DataFrame:
    """A measure of the cells with these fields: one row per seed, one column per group of the other fields."""
    for key, value in fixed.items():
        frame = frame[frame[key] == value]
    return frame.pivot(index="seed", columns=[key for key in KEYS if key not in fixed], values=measure)


def difference(frame: pd.DataFrame, measure: str = "test.psnr", **pair: tuple[str, str]) -> Difference:
    """Of cells that differ in one field alone, as in `method=("far", "off")`: value less base, paired by seed."""
    ((key, (value, base)),) = pair.items()
    return paired_difference(_differences(frame, measure, key, value, base))


def main_cells(frame: pd.DataFrame) -> pd.DataFrame:
    """The cells of each scene's main protocol: its fewest views, dense first points. Other scenes are left out."""
    dense = frame[frame.start == "dense"]
    return dense[dense.views == dense.groupby("scene").views.transform("min")]


def findings(frame: pd.DataFrame) -> list[str]:
    """The results in sentences, each with its pairs, scenes, spread and interval; none of cells without pairs."""
    main, sentences = main_cells(frame), []
    paper = frame.merge(main[KEYS[:2]].drop_duplicates())
    paper = paper[paper.method == PAPER]
    names = {
        PAPER: f"The paper's rule ({PAPER})",
        OFF: "no dropping (off)",
        FIXED: f"a fixed rate of the same mean ({FIXED})",
    }
    names |= {"dense": "Dense first points", "sift": f"those of SIFT, both with {PAPER}"}
    for cells, key, value, base in (
        (main, "method", PAPER, OFF),
        (main, "method", FIXED, OFF),
        (main, "method", PAPER, FIXED),
        (paper, "start", "dense", "sift"),
    ):
        gain, cost = (difference(cells, measure, **{key: (value, base)}) for measure in ("test.psnr", LPIPS))
        if not gain.pairs:
            continue
        by_scene = {name: difference(some, **{key: (value, base)}) for name, some in cells.groupby("scene", sort=False)}
        scenes = [f"{name.rpartition('/')[2]} {found.text()}" for name, found in by_scene.items() if found.pairs]
        noise = noise_floor(_differences(cells, "test.psnr", key, value, base))
        spread = f", standard deviation of a pair: {noise.sd:.2f} dB" if noise.freedom else ""
        lpips = f" LPIPS (less is better): {cost.text(3)}." if cost.pairs else ""
        sentences.append(
            f"{names[value][0].upper()}{names[value][1:]} over {names[base]}: {gain.text()} dB of test PSNR (mean [95 % "
            f"interval]; pairs: {gain.pairs}, scenes: {len(scenes)}{spread}).{lpips} By scene: {'; '.join(scenes)} dB."
        )
    noise = noise_floor(wide(frame, "test.psnr"))
    if noise.freedom:
        sentences.append(
            f"Where nothing but the seed differs, two single runs differ by up to {noise.between_means(1):.2f} dB, and two "
            f"means of three by up to {noise.between_means(3):.2f} dB, 95 times in 100 ({noise.groups} groups of runs)."
        )
    return sentences


def sparse_tables(frame: pd.DataFrame) -> list[Table]:
    """All tables that have a line, the main one first."""
    main = main_cells(frame)
    ablations = [table for _, cells in main.groupby(KEYS[:3], sort=False) for table in _ablations(cells)]
    tables = {
        "Test views: mean (sd) over n seeds; paired differences over off with their 95 % interval; the paper's figures "
        "are means of all its scenes in other sizes, best of five runs: not comparable in level, only in direction": (
            _methods(main)
        ),
        "Numbers of views": _views(frame),
        "First points": _starts(frame),
        **dict(ablations),
        "Noise between seeds under identical settings, pooled, and the difference that it makes 1 time in 20": (
            _noise(frame, main)
        ),
        "Cost, overfitting and co-adaptation: mean (sd) over n seeds": _cost(main),
        "Scenes, splits and settings": _protocol(frame),
    }
    return [Table(title, pd.DataFrame(lines)) for title, lines in tables.items() if lines]


Lines = list[dict[str, str]]


def _differences(frame: pd.DataFrame, measure: str, key: str, value: str, base: str) -> pd.DataFrame:
    if value == base or not {value, base} <= set(frame[key]):
        return pd.DataFrame()
    return wide(frame, measure, **{key: value}) - wide(frame, measure, **{key: base})


def _methods(main: pd.DataFrame) -> Lines:
    lines = [line for _, cells in main.groupby(KEYS[:3], sort=False) for line in _quality_lines(cells)]
    is_llff = (main.views == 3) & main.scene.map(lambda scene: benchmark_of(scene, 3) == "LLFF").astype(bool)
    means = {"LLFF scenes": main[is_llff]} | ({} if is_llff.all() else {"scenes": main})
    for kind, cells in means.items():
        found = cells[cells.method.isin(MAIN)].groupby("scene").method.nunique()
        common = cells[cells.scene.isin(found.index[found == cells.method[cells.method.isin(MAIN)].nunique()])]
        if common.scene.nunique() > 1:
            lines += _quality_lines(common, kind)
    return lines


def _views(frame: pd.DataFrame) -> Lines:
    dense = frame[frame.start == "dense"]
    several = dense[dense.groupby("scene").views.transform("nunique") > 1]
    lines = [line for _, cells in several.groupby(KEYS[:3], sort=False) for line in _quality_lines(cells)]
    for views, cells in several.groupby("views"):
        if cells.scene.nunique() > 1:
            lines += _quality_lines(cells, "scenes", f", {views} views")
    return lines


def _quality_lines(cells: pd.DataFrame, kind: str = "", more: str = "") -> Lines:
    """One line per main method that all settings have: of one setting, or of the mean over several by seed."""
    scenes = cells[KEYS[:2]].drop_duplicates()
    names = ", ".join(scene.rpartition("/")[2] for scene in scenes.scene)
    name = f"mean of {len(scenes)} {kind} ({names}){more}" if kind else _setting(cells)
    benchmarks = {(benchmark_of(*setting), setting[1]) for setting in scenes.itertuples(index=False, name=None)}
    benchmark, views = benchmarks.pop() if len(benchmarks) == 1 else (None, 0)
    lines = []
    for method in MAIN:
        if cells[cells.method == method].scene.nunique() < len(scenes):
            continue
        quality = _quality(cells, method)
        lines.append(
            {
                "scene": name,
                "method": method,
                **{key: quality[key] for key in ("n", "PSNR [dB]", "best")},
                "over off [dB] (pairs)": _counted(difference(cells, method=(method, OFF))),
                **{key: quality[key] for key in ("SSIM", "LPIPS")},
                "LPIPS over off": difference(cells, LPIPS, method=(method, OFF)).text(3),
                "paper, mean of its scenes: PSNR / SSIM / LPIPS": _figures(benchmark, views, method),
                "paper: over off": _printed(benchmark, views, method, OFF),
            }
        )
    return lines


def _quality(cells: pd.DataFrame, method: str) -> dict[str, str]:
    """By seed the mean over the settings, of the seeds that all have: of PSNR n, mean (sd) and best, of others mean."""
    psnr, ssim, lpips = (wide(cells, measure, method=method).dropna().mean(axis=1) for measure in QUALITY)
    return _spread(psnr) | {"SSIM": mean_sd(ssim, 3), "LPIPS": mean_sd(lpips, 3)}


def _starts(frame: pd.DataFrame) -> Lines:
    lines = []
    for (scene, views), setting in frame.groupby(KEYS[:2], sort=False):
        for method in [method for method in MAIN if setting[setting.method == method].start.nunique() > 1]:
            cells = setting[setting.method == method]
            lines += [
                {
                    "scene": f"{scene}, {views} views",
                    "method": method,
                    "start": _start(start, set(some["init.kind"])),
                    **_spread(some["test.psnr"]),
                    "first points": mean_sd(some["init.points"], 0),
                    "their CPU [s]": mean_sd(some["init.seconds"], 0),
                    "over sift [dB] (pairs)": _counted(difference(cells, start=(start, "sift"))),
                    "over off, same start [dB] (pairs)": _counted(
                        difference(setting[setting.start == start], method=(method, OFF))
                    ),
                }
                for start, some in cells.groupby("start", sort=False)
            ]
    return lines


def _start(start: str, gave: set[str]) -> str:
    """The name of a start; with what it gave where that is something else, and a warning."""
    if start in ("dense", "sift") and gave - {start}:
        return f"{start} (gave {', '.join(sorted(gave - {start}))})"
    return f"{start} (sees test views)" if start in ("model-points", "full-model") else start


def _ablations(cells: pd.DataFrame) -> list[tuple[str, Lines]]:
    there, where = set(cells.method), _setting(cells)
    if there <= set(MAIN):
        return []
    views = cells.views.iloc[0]
    benchmark, tables = benchmark_of(cells.scene.iloc[0], views), []
    for title, family in FAMILIES.items():
        lines = []
        for method in [m for m in (OFF, PAPER, *family) if m in there] if there & set(family) else []:
            quality = _quality(cells, method)
            gains = {f"over {b} [dB] (pairs)": _counted(difference(cells, method=(method, b))) for b in (OFF, PAPER)}
            line = {"method": method, **{key: quality[key] for key in ("n", "PSNR [dB]", "best")}, **gains}
            line |= {key: quality[key] for key in ("SSIM", "LPIPS")}
            line["paper: PSNR / SSIM / LPIPS"] = _figures(benchmark, views, method)
            lines.append(line | {f"paper: over {b}": _printed(benchmark, views, method, b) for b in (OFF, PAPER)})
        tables.append((f"{title} ({where})", lines))
    lines = [
        {
            "": f"{method} over {base}",
            "PSNR [dB] (pairs)": _counted(gain),
            "paper": _printed(benchmark, views, method, base),
        }
        for method, base in EQUAL_MEAN_RATE.items()
        if (gain := difference(cells, method=(method, base))).pairs
    ]
    return [*tables, (f"A growing rate against a fixed one of the same mean ({where})", lines)]


def _noise(frame: pd.DataFrame, main: pd.DataFrame) -> Lines:
    scenes = [(scene, "test.psnr", frame[frame.scene == scene]) for scene in main.scene.unique()]
    lines = []
    for name, measure, cells in [*(scenes if len(scenes) > 1 else []), *(("all cells", m, frame) for m in QUALITY)]:
        noise = noise_floor(wide(cells, measure))
        numbers = {
            "sd between seeds": noise.sd,
            "two single runs": noise.between_means(1),
            "two means of 3": noise.between_means(3),
            "two means of 5": noise.between_means(5),
            "best of 5 over the mean": noise.best_of_five_gain(),
        }
        label = {"test.psnr": "PSNR [dB]", LPIPS: "LPIPS"}.get(measure, "SSIM")
        line = {"scene": name, "measure": label, "groups": str(noise.groups), "degrees of freedom": str(noise.freedom)}
        if noise.freedom:
            lines.append(line | {key: f"{value:.{QUALITY[measure] + 1}f}" for key, value in numbers.items()})
    return lines


def _cost(main: pd.DataFrame) -> Lines:
    return [
        {
            "scene": _setting(cells),
            "method": str(cells.method.iloc[0]),
            "n": str(len(cells)),
            "PSNR, training less test views [dB]": mean_sd(cells["train.psnr"] - cells["test.psnr"], 2),
            "wall clock [s]": mean_sd(cells.wall_seconds, 0),
            "CPU [s]": mean_sd(cells.cpu_seconds, 0),
            "Gaussians": mean_sd(cells.gaussians, 0),
            "peak memory [MiB]": mean_sd(cells.peak_rss_mb, 0),
            "co-adaptation [1e-3]": mean_sd(1e3 * cells.coadaptation, 2),
        }
        for _, cells in main.groupby(KEYS, sort=False)
    ]


def _protocol(frame: pd.DataFrame) -> Lines:
    """Sizes, splits, and the settings that all fits of a scene and number of views share."""
    lines = []
    for (scene, views), cells in frame.groupby(KEYS[:2]):
        train, test, (height, width) = (cells[f"protocol.{key}"].iloc[0] for key in ("train", "test", "image_size"))
        shared = set.intersection(*(set(fit.items()) for fit in cells.fit))
        counts = {"training views": len(train), "test views": len(test), "cells": len(cells)}
        fit = ", ".join(f"{key} {value}" for key, value in sorted(shared)) or "-"
        line = {"scene": f"{scene}, {views} views", **{key: str(value) for key, value in counts.items()}}
        lines.append(line | {"size": f"{width}x{height}", "what all fits share": fit})
    return lines


def _setting(cells: pd.DataFrame) -> str:
    return "{}, {} views, {}".format(*cells[KEYS[:3]].iloc[0])


def _spread(psnr: pd.Series) -> dict[str, str]:
    """How many, mean (sd) and best, in dB."""
    psnr = psnr.dropna()
    return {"n": str(len(psnr)), "PSNR [dB]": mean_sd(psnr, 2), "best": f"{psnr.max():.2f}" if len(psnr) else "-"}


def _counted(gain: Difference) -> str:
    return f"{gain.text()} ({gain.pairs})" if gain.pairs else "-"


def _figures(benchmark: str | None, views: int, method: str) -> str:
    return _either("{:.2f} / {:.3f} / {:.3f}".format(*figures) for figures in published(benchmark, views, method))


def _printed(benchmark: str | None, views: int, method: str, base: str) -> str:
    found = published_differences(benchmark, views, method, base) if method != base else []
    return _either(f"{value:+.2f}" for value in found)


def _either(texts: Iterable[str]) -> str:
    return " or ".join(texts) or "-"
