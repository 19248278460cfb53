"""The tables of the study, each figure with its n; the paper's printed figures stand beside ours."""

from collections.abc import Iterable, Sequence

import pandas as pd

from kgs.bench.output import mean_sd

from .findings import headline
from .pairs import KEYS, LPIPS, PSNR, difference, grouped, main_cells, noise_floor, wide, with_measures
from .presets import AUTO, AUTO_OFF, FAMILIES, MAIN, OFF, PAPER
from .published import benchmark_of, published, published_difference
from .texts import table_of

QUALITY = {PSNR: "PSNR [dB]", "test.ssim_zero_padded": "SSIM", LPIPS: "LPIPS"}
_COST = {  # a column, and its decimals
    "PSNR, training less test views [dB]": ("gap", 2),
    "wall clock [s]": ("wall_seconds", 0),
    "CPU [s]": ("cpu_seconds", 0),
    "Gaussians": ("gaussians", 0),
    "peak memory [MiB]": ("peak_rss_mb", 0),
    "co-adaptation [1e-3]": ("thousandths", 2),
}
_HEADLINE = "Paired differences of the means over scenes; those of one scene have their interval over seeds"
_TITLE = """Test views: mean (sd) over n seeds; paired differences over off with their 95 % intervals; the paper's \
figures are means of all its scenes after more steps, best of five runs: comparable in direction, not in level"""
_NOISE = "Noise between seeds under identical settings, pooled, and the difference that it makes 1 time in 20"
BEST_OF_5 = 1.163  # how far the best of five runs lies over the mean on average, in standard deviations
HEAD = (*MAIN, AUTO, AUTO_OFF)
Lines = list[dict[str, str]]


def sparse_tables(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """All tables that have a line, of text, by title; the one with the comparisons first."""
    main = main_cells(frame)
    dense = frame[frame.start == "dense"]
    default, *families = FAMILIES
    methods = FAMILIES[default]
    bases = (PAPER, OFF, AUTO_OFF)
    tables = {
        _HEADLINE: headline(frame),
        _TITLE: _settings(main) + _means(main),
        default: _settings(dense, methods, bases) + _means(main, methods, bases),
        "Numbers of views": _by_views(dense),
        "Initial points": _starts(frame),
    }
    for title in families:
        scenes = main[main.method.isin({*FAMILIES[title]} - {*HEAD})].scene
        tables[title] = _settings(main[main.scene.isin(scenes)], (OFF, PAPER, *FAMILIES[title]), (OFF, PAPER))
    tables |= {
        _NOISE: _noise(frame),
        "Cost, overfitting and co-adaptation: mean (sd) over n seeds": _costs(main),
        "Scenes, splits and settings": _protocol(frame),
    }
    return {title: table_of(lines) for title, lines in tables.items() if lines}


def _by_views(dense: pd.DataFrame) -> Lines:
    """The scenes with several numbers of views, and for each number the mean over scenes."""
    several = dense[dense.groupby("scene").views.transform("nunique") > 1]
    lines = _settings(several)
    for (n,), cells in grouped(several.sort_values("views", kind="stable"), "views"):
        lines += _compared(cells, HEAD, f"mean of {{}} scenes ({{}}), {n} views")
    return lines


def _costs(main: pd.DataFrame) -> Lines:
    lines = []
    for (*_, method), cells in grouped(with_measures(main), *KEYS):
        line = {"scene": _setting(cells), "method": method, "n": str(len(cells))}
        lines.append(line | {head: mean_sd(cells[key], decimals) for head, (key, decimals) in _COST.items()})
    return lines


def _protocol(frame: pd.DataFrame) -> Lines:
    """Each scene's split, size and common settings."""
    lines = []
    for (scene, views), cells in grouped(frame.sort_values([*KEYS[:2]]), *KEYS[:2]):
        protocol = cells.iloc[0].filter(like="protocol.").rename(lambda name: name.removeprefix("protocol."))
        height, width = protocol.image_size
        line = {"scene": f"{scene}, {views} views"}
        line |= {"training views": str(len(protocol.train)), "test views": str(len(protocol.test))}
        line |= {"cells": str(len(cells)), "size": f"{width}x{height}"}
        shared = sorted(set.intersection(*({*fit.items()} for fit in cells.fit)))
        line["what all fits share"] = ", ".join(f"{key} {value}" for key, value in shared) or "-"
        lines.append(line)
    return lines


def _settings(cells: pd.DataFrame, methods: Sequence[str] = HEAD, bases: Sequence[str] = (OFF,)) -> Lines:
    return [line for _, some in grouped(cells, *KEYS[:3]) for line in _compared(some, methods, "", bases)]


def _means(main: pd.DataFrame, methods: Sequence[str] = HEAD, bases: Sequence[str] = (OFF,)) -> Lines:
    """Lines of means over scenes, those of LLFF and all, of the methods that the same scenes have."""
    methods_of = dict[tuple[str, ...], list[str]]()  # by the scenes that they have
    for (method,), cells in grouped(main[main.method.isin(methods)], "method"):
        methods_of.setdefault(tuple(cells.scene.unique()), []).append(method)
    lines = Lines()
    for scenes, some_methods in methods_of.items():
        some = main[main.scene.isin(scenes)]
        llff = some[(some.views == 3) & some.scene.map(lambda scene: benchmark_of(scene, 3) == "LLFF").astype(bool)]
        lines += _compared(llff, some_methods, "mean of {} LLFF scenes ({})", bases)
        lines += _compared(some, some_methods, "mean of {} scenes ({})", bases) if len(llff) < len(some) else []
    return lines


def _compared(cells: pd.DataFrame, methods: Iterable[str], mean: str = "", bases: Sequence[str] = (OFF,)) -> Lines:
    """One line per method that all scenes have: of one setting, or (`mean`, their name) by seed over several."""
    scenes = cells.scene.unique()
    if mean and len(scenes) < 2:
        return []
    benchmarks = {(benchmark_of(scene, views), views) for (scene, views), _ in grouped(cells, *KEYS[:2])}
    benchmark, views = benchmarks.pop() if len(benchmarks) == 1 else (None, 0)  # that all these cells are from
    name = mean.format(len(scenes), ", ".join(scene.rpartition("/")[2] for scene in scenes)) or _setting(cells)
    lines = Lines()
    for method in methods:
        if cells[cells.method == method].scene.nunique() < len(scenes):
            continue
        psnr, ssim, lpips = (wide(cells, measure, method=method).dropna().mean(axis=1) for measure in QUALITY)
        line = {"scene": name, "method": method} | _spread(psnr)
        line["LPIPS"] = mean_sd(lpips, 3)
        line["SSIM"] = mean_sd(ssim, 3)
        for base in bases:
            line[f"over {base} [dB] (pairs)"] = _gain(cells, method, base)
            line[f"LPIPS over {base}"] = difference(cells, "method", method, base, LPIPS).text(3)
        line["paper: PSNR / SSIM / LPIPS"] = published(benchmark, views, method)
        for base in bases:
            line[f"paper: over {base}"] = published_difference(benchmark, views, method, base)
        lines.append(line)
    return lines


def _starts(frame: pd.DataFrame) -> Lines:
    lines = []
    for (scene, views, method), cells in grouped(frame[frame.method.isin(MAIN)], *KEYS[:2], "method"):
        if cells.start.nunique() < 2:
            continue
        same = frame[(frame.scene == scene) & (frame.views == views)]
        for (start,), some in grouped(cells, "start"):
            others = sorted({*some["init.kind"]} - {start}) if start in ("dense", "sift") else []
            note = " (sees test views)" if start == "model-points" else ""
            line = {"scene": f"{scene}, {views} views", "method": method}
            line["start"] = f"{start} (gave {', '.join(others)})" if others else start + note
            line |= _spread(some[PSNR])
            line["initial points"] = mean_sd(some["init.points"], 0)
            line["their CPU [s]"] = mean_sd(some["init.seconds"], 0)
            line["over sift [dB] (pairs)"] = _gain(cells, start, "sift", "start")
            line["over off, same start [dB] (pairs)"] = _gain(same[same.start == start], method, OFF)
            lines.append(line)
    return lines


def _noise(frame: pd.DataFrame) -> Lines:
    by_scene = [(scene, PSNR, cells) for (scene,), cells in grouped(frame, "scene")]
    parts = by_scene if len(by_scene) > 1 else []
    parts += [("all cells", measure, frame) for measure in QUALITY]
    lines = []
    for name, measure, cells in parts:
        noise = noise_floor(wide(cells, measure))
        if not noise.freedom:
            continue
        line = {"scene": name, "measure": QUALITY[measure]}
        line |= {"groups": str(noise.groups), "degrees of freedom": str(noise.freedom)}
        numbers = {"sd between seeds": noise.sd, "two single runs": noise.between_means(1)}
        numbers |= {f"two means of {n}": noise.between_means(n) for n in (3, 5)}
        numbers["best of 5 over the mean"] = BEST_OF_5 * noise.sd
        decimals = 3 if measure == PSNR else 4
        lines.append(line | {head: f"{number:.{decimals}f}" for head, number in numbers.items()})
    return lines


def _setting(cells: pd.DataFrame) -> str:
    return "{}, {} views, {}".format(*cells[[*KEYS[:3]]].iloc[0])


def _spread(psnr: "pd.Series[float]") -> dict[str, str]:
    return {"n": str(psnr.count()), "PSNR [dB]": mean_sd(psnr, 2), "best": f"{psnr.max():.2f}" if psnr.count() else "-"}


def _gain(cells: pd.DataFrame, value: str, base: str, key: str = "method") -> str:
    gain = difference(cells, key, value, base)
    return f"{gain.text()} ({gain.pairs})" if gain.pairs else "-"
