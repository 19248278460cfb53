"""The tables of the study, each figure with its n; the paper's printed figures stand beside ours."""

from collections.abc import Iterable, Sequence

import pandas as pd

from kgs.bench.output import mean_sd

from .findings import headline, regret
from .pairs import KEYS, LPIPS, PSNR, difference, grouped, main_cells, noise_floor, wide
from .presets import AUTO, AUTO_OFF, FAMILIES, MAIN, OFF, PAPER
from .published import benchmark_of, priors, published, published_difference

QUALITY = {PSNR: "PSNR [dB]", "test.ssim_zero_padded": "SSIM", LPIPS: "LPIPS"}
_COST = {"PSNR, training less test views [dB]": "gap", "wall clock [s]": "wall_seconds", "CPU [s]": "cpu_seconds"}
_COST |= {"Gaussians": "gaussians", "peak memory [MiB]": "peak_rss_mb", "co-adaptation [1e-3]": "thousandths"}
_HEADLINE = "Paired differences of the means over scenes; those of one scene have their interval over seeds"
_TITLE = """Test views: mean (sd) over n seeds; paired differences over off with their 95 % intervals; the paper's \
figures are means of all its scenes after more steps, best of five runs: comparable in direction, not in level"""
_REGRET = """Regret: the default against the best of a scene's other methods, picked after the fact on the same test \
views; that flatters what is picked, the more so out of many"""
BEST_OF_5 = 1.163  # how far the best of five runs lies over the mean on average, in standard deviations
HEAD = (*MAIN, AUTO, AUTO_OFF)
Lines = list[dict[str, str]]


def sparse_tables(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """All tables that have a line, of text, by title; the one with the comparisons first."""
    main, dense = main_cells(frame), frame[frame.start == "dense"]
    several = dense[dense.groupby("scene").views.transform("nunique") > 1]
    by_views = _settings(several)
    for (n,), cells in grouped(several.sort_values("views", kind="stable"), "views"):
        by_views += _compared(cells, HEAD, f"mean of {{}} scenes ({{}}), {n} views")
    tables = {_HEADLINE: headline(frame), _TITLE: _settings(main) + _means(main)}
    default, *families = FAMILIES
    against = FAMILIES[default], (PAPER, OFF, AUTO_OFF)
    tables[default] = _settings(dense, *against) + _means(main, *against)
    tables |= {_REGRET: regret(frame), "Numbers of views": by_views, "Initial points": _starts(frame)}
    for title in families:
        scenes = main[main.method.isin({*FAMILIES[title]} - {*HEAD})].scene
        tables[title] = _settings(main[main.scene.isin(scenes)], (OFF, PAPER, *FAMILIES[title]), (OFF, PAPER))
    tables["What the probes chose: the degree of harmonics, by seed"] = _probes(frame)
    title = "Noise between seeds under identical settings, pooled, and the difference that it makes 1 time in 20"
    tables[title] = _noise(frame)
    main = main.assign(gap=main["train.psnr"] - main[PSNR], thousandths=1e3 * main.coadaptation)
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
    found = {title: pd.DataFrame(lines).fillna("-") for title, lines in tables.items() if lines}
    return {title: table.loc[:, (table != "-").any()] for title, table in found.items()}


def _settings(cells: pd.DataFrame, methods: Sequence[str] = HEAD, bases: Sequence[str] = (OFF,)) -> Lines:
    return [line for _, some in grouped(cells, *KEYS[:3]) for line in _compared(some, methods, "", bases)]


def _means(main: pd.DataFrame, methods: Sequence[str] = HEAD, bases: Sequence[str] = (OFF,)) -> Lines:
    """Lines of means over scenes, those of LLFF and all, of the methods that the same scenes have."""
    lines, alike = Lines(), dict[tuple[str, ...], list[str]]()
    for (method,), cells in grouped(main[main.method.isin(methods)], "method"):
        alike.setdefault(tuple(cells.scene.unique()), []).append(method)
    for scenes, some_methods in alike.items():
        some = main[main.scene.isin(scenes)]
        llff = some[(some.views == 3) & some.scene.map(lambda scene: benchmark_of(scene, 3) == "LLFF").astype(bool)]
        lines += _compared(llff, some_methods, "mean of {} LLFF scenes ({})", bases)
        lines += _compared(some, some_methods, "mean of {} scenes ({})", bases) if len(llff) < len(some) else []
    return lines


def _compared(cells: pd.DataFrame, methods: Iterable[str], mean: str = "", bases: Sequence[str] = (OFF,)) -> Lines:
    """One line per method that all scenes have: of one setting, or (`mean`, their name) by seed over several."""
    scenes, lines = cells.scene.unique(), Lines()
    if mean and len(scenes) < 2:
        return lines
    benchmark, names = _benchmark(cells), ", ".join(scene.rpartition("/")[2] for scene in scenes)
    name = mean.format(len(scenes), names) if mean else _setting(cells)
    known = "-" if mean else priors(scenes[0], cells.views.iloc[0], max(cells["protocol.image_size"].iloc[0]))
    for method in methods:
        if cells[cells.method == method].scene.nunique() == len(scenes):
            psnr, ssim, lpips = (wide(cells, measure, method=method).dropna().mean(axis=1) for measure in QUALITY)
            line = {"scene": name, "method": method} | _spread(psnr)
            line |= {"LPIPS": mean_sd(lpips, 3), "SSIM": mean_sd(ssim, 3)}
            for base in bases:
                line[f"over {base} [dB] (pairs)"] = _gain(cells, method, base)
                line[f"LPIPS over {base}"] = difference(cells, "method", method, base, LPIPS).text(3)
            line["pretrained priors: PSNR"] = known
            line["paper: PSNR / SSIM / LPIPS"] = published(*benchmark, method)
            lines.append(line | {f"paper: over {b}": published_difference(*benchmark, method, b) for b in bases})
    return lines


def _probes(frame: pd.DataFrame) -> Lines:
    known = frame[frame["needs.sh_degree.chosen"].notna()].rename(
        columns=lambda name: name.removeprefix("needs.sh_degree.")
    )
    heads = {
        "chosen": ("chosen", "{:.0f}"),
        "gain of degree 3 [dB]": ("gain", "{:+.2f}"),
        "noise [dB]": ("noise", "{:.2f}"),
    }
    return [
        {"scene": f"{scene}, {views} views", "method": method, "by": ", ".join(cells.by.unique())}
        | {head: ", ".join(text.format(x) for x in cells[key].dropna()) or "-" for head, (key, text) in heads.items()}
        for (scene, views, method), cells in grouped(known.sort_values("seed", kind="stable"), *KEYS[:2], "method")
    ]


def _starts(frame: pd.DataFrame) -> Lines:
    lines = []
    for (scene, views, method), cells in grouped(frame[frame.method.isin(MAIN)], *KEYS[:2], "method"):
        same = frame[(frame.scene == scene) & (frame.views == views)]
        for (start,), some in grouped(cells, "start") if cells.start.nunique() > 1 else ():
            gave = sorted({*some["init.kind"]} - {start}) if start in ("dense", "sift") else []
            note = " (sees test views)" if start in ("model-points", "full-model") else ""
            line = {"scene": f"{scene}, {views} views", "method": method}
            line["start"] = f"{start} (gave {', '.join(gave)})" if gave else start + note
            line |= _spread(some[PSNR])
            line |= {
                "initial points": mean_sd(some["init.points"], 0),
                "their CPU [s]": mean_sd(some["init.seconds"], 0),
            }
            line["over sift [dB] (pairs)"] = _gain(cells, start, "sift", "start")
            line["over off, same start [dB] (pairs)"] = _gain(same[same.start == start], method, OFF)
            lines.append(line)
    return lines


def _noise(frame: pd.DataFrame) -> Lines:
    scenes = [(scene, PSNR, cells) for (scene,), cells in grouped(frame, "scene")]
    lines = []
    for name, measure, cells in [*(scenes if len(scenes) > 1 else []), *(("all cells", m, frame) for m in QUALITY)]:
        noise = noise_floor(wide(cells, measure))
        label, decimals = QUALITY[measure], 3 if measure == PSNR else 4
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
