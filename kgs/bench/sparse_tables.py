"""The tables of the study of sparse views, each figure with its n; the paper's printed figures stand beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from .published import PAPER, Figures, benchmark_of, published, published_differences
from .sparse_groups import (
    EQUAL_MEAN_RATE,
    FAMILIES,
    FIXED,
    MAIN,
    OFF,
    Groups,
    all_settings,
    main_settings,
    measured,
    ordered,
    over,
)
from .statistics import (
    Difference,
    Group,
    Summary,
    average_over_scenes,
    by_seed,
    noise_floor,
    paired,
    paired_difference,
    summarize,
)

__all__ = ["QUALITY", "Table", "headline", "sparse_tables"]

STARTS = ("sift", "random", "model-points", "full-model", "dense", "scene")
LPIPS = "test.lpips_vgg_unscaled"
QUALITY = {"test.psnr": 2, "test.ssim_zero_padded": 3, LPIPS: 3}
_QUALITY_COLUMNS = (
    *("method", "n", "PSNR [dB]", "best", "over off [dB] (pairs)", "SSIM", "LPIPS", "LPIPS over off"),
    *("paper, mean of its scenes: PSNR / SSIM / LPIPS", "paper: over off"),
)


class Table(NamedTuple):
    """One table: its arguments are those of `markdown_table` and its siblings."""

    title: str
    columns: Sequence[str]
    rows: list[list[str]]
    first: str


def sparse_tables(groups: Groups) -> list[Table]:
    """All tables that have a line, the main one first."""
    main = main_settings(groups)
    tables = [_methods(groups, main), _views(groups, main), _starts(groups)]
    tables += [table for setting in main for table in _ablations(groups, setting)]
    tables += [_noise(groups, main), _cost(groups, main)]
    return [table for table in tables if table.rows]


def headline(groups: Groups) -> list[str]:
    """One sentence a comparison of the main methods: the mean over scenes of their paired differences."""
    sentences = []
    for method, base in ((PAPER, OFF), (FIXED, OFF), (PAPER, FIXED)):
        scenes = [over(groups, setting._replace(method=method), method=base) for setting in main_settings(groups)]
        difference = paired_difference(scenes)
        if difference is not None:
            counts = f"pairs: {difference.pairs}, scenes: {sum(map(bool, scenes))}"
            shown = difference.text(2)
            sentences.append(f"{method} over {base}: {shown} dB of test PSNR (mean [95 % interval]; {counts}).")
    return sentences


def _methods(groups: Groups, main: list[Group]) -> Table:
    rows = [row for setting in main for row in _quality_rows(groups, [setting], _setting(setting))]
    llff = [setting for setting in main if benchmark_of(setting.scene, setting.views) == "LLFF" and setting.views == 3]
    for settings, kind in ((llff, "LLFF scenes"), (main if main != llff else [], "scenes")):
        methods = [m for m in MAIN if any(setting._replace(method=m) in groups for setting in settings)]
        common = [s for s in settings if all(s._replace(method=m) in groups for m in methods)]
        if len(common) > 1:
            rows += _quality_rows(groups, common, _mean_of(common, kind))
    title = (
        "Test views: mean (sd) over n seeds; paired differences over off with their 95 % interval; the paper's figures "
        "are means of all its scenes in other sizes, best of five runs: not comparable in level, only in direction"
    )
    return Table(title, _QUALITY_COLUMNS, rows, "scene")


def _views(groups: Groups, main: list[Group]) -> Table:
    rows = []
    by_views: dict[int, list[Group]] = {}
    for setting in main:
        several = [s for s in all_settings(groups) if (s.scene, s.start) == (setting.scene, setting.start)]
        for given in several if len(several) > 1 else []:
            rows += _quality_rows(groups, [given], _setting(given))
            by_views.setdefault(given.views, []).append(given)
    for views, settings in sorted(by_views.items()):
        if len(settings) > 1:
            rows += _quality_rows(groups, settings, f"{_mean_of(settings, 'scenes')}, {views} views")
    return Table("Numbers of views", _QUALITY_COLUMNS, rows, "scene")


def _quality_rows(groups: Groups, settings: list[Group], name: str) -> list[list[str]]:
    """One line a main method: of one setting, or of the mean over several by seed."""
    benchmarks = {(benchmark_of(setting.scene, setting.views), setting.views) for setting in settings}
    benchmark, views = next(iter(benchmarks)) if len(benchmarks) == 1 else (None, 0)
    rows = []
    for method in MAIN:
        found = [setting._replace(method=method) for setting in settings]
        if not all(group in groups for group in found):
            continue
        psnr, others = _quality(groups, found)
        gain, cost = (
            paired_difference(over(groups, group, measure, method=OFF) for group in found) if method != OFF else None
            for measure in ("test.psnr", LPIPS)
        )
        rows.append(
            [
                *(name, method, *psnr, _difference(gain), *others),
                "-" if cost is None else cost.text(3),
                _figures(published(benchmark, views, method)),
                _printed(published_differences(benchmark, views, method, OFF)) if method != OFF else "-",
            ]
        )
    return rows


def _quality(groups: Groups, found: list[Group]) -> tuple[tuple[str, str, str], list[str]]:
    """Of PSNR how many, mean (sd) and best, of the other measures mean (sd): by seed the mean over the groups."""
    psnr, *others = (
        summarize(average_over_scenes([measured(groups, group, measure) for group in found]).values())
        for measure in QUALITY
    )
    return _spread(psnr), [_mean(*other) for other in zip(others, list(QUALITY.values())[1:], strict=True)]


def _starts(groups: Groups) -> Table:
    rows = []
    for scene, views in dict.fromkeys((s.scene, s.views) for s in all_settings(groups)):
        for method in MAIN:
            starts = ordered((g.start for g in groups if g == (scene, views, g.start, method)), STARTS)
            for start in starts if len(starts) > 1 else []:
                group = Group(scene, views, start, method)
                results = groups[group]
                points, seconds = (by_seed(results, f"init.{key}").values() for key in ("points", "seconds"))
                over_sift = paired_difference([over(groups, group, start="sift")]) if start != "sift" else None
                over_off = paired_difference([over(groups, group, method=OFF)]) if method != OFF else None
                row = [f"{scene}, {views} views", method, _start(start, results)]
                row += [*_spread(summarize(measured(groups, group).values())), _mean(summarize(points), 0)]
                rows.append([*row, _mean(summarize(seconds), 0), _difference(over_sift), _difference(over_off)])
    columns = (
        *("method", "start", "n", "PSNR [dB]", "best", "first points", "their CPU [s]"),
        *("over sift [dB] (pairs)", "over off, same start [dB] (pairs)"),
    )
    return Table("First points", columns, rows, "scene")


def _start(start: str, results: Mapping[int, Mapping[str, Any]]) -> str:
    """The name of a start; with what it gave where that is something else, and a warning."""
    gave = {str(result["init"]["kind"]) for result in results.values()} - {start}
    if start in ("dense", "sift") and gave:
        return f"{start} (gave {', '.join(sorted(gave))})"
    return f"{start} (sees test views)" if start in ("model-points", "full-model") else start


def _ablations(groups: Groups, setting: Group) -> list[Table]:
    there = {group.method for group in groups if group[:3] == setting[:3]}
    if there <= set(MAIN):
        return []
    tables, benchmark, where = [], benchmark_of(setting.scene, setting.views), _setting(setting)
    columns = (
        *("n", "PSNR [dB]", "best", "over off [dB] (pairs)", f"over {PAPER} [dB] (pairs)", "SSIM", "LPIPS"),
        *("paper: PSNR / SSIM / LPIPS", "paper: over off", f"paper: over {PAPER}"),
    )
    for title, family in FAMILIES.items():
        rows = []
        for method in [m for m in (OFF, PAPER, *family) if m in there] if there & set(family) else []:
            group = setting._replace(method=method)
            bases = (OFF, PAPER)
            gains = [paired_difference([over(groups, group, method=b)]) if b != method else None for b in bases]
            printed = [published_differences(benchmark, setting.views, method, b) if b != method else () for b in bases]
            psnr, others = _quality(groups, [group])
            row = [method, *psnr, *map(_difference, gains), *others]
            rows.append([*row, _figures(published(benchmark, setting.views, method)), *map(_printed, printed)])
        tables.append(Table(f"{title} ({where})", columns, rows, "method"))
    rows = []
    for method, base in EQUAL_MEAN_RATE.items():
        gain = paired_difference([over(groups, setting._replace(method=method), method=base)])
        if gain is not None:
            printed_gain = published_differences(benchmark, setting.views, method, base)
            rows.append([f"{method} over {base}", _difference(gain), _printed(printed_gain)])
    title = f"A growing rate against a fixed one of the same mean ({where})"
    return [*tables, Table(title, ("PSNR [dB] (pairs)", "paper"), rows, "")]


def _noise(groups: Groups, main: list[Group]) -> Table:
    columns = (
        *("measure", "groups", "degrees of freedom", "sd between seeds"),
        *("two single runs", "two means of 3", "two means of 5", "best of 5 over the mean"),
    )
    kinds = [(setting.scene, "test.psnr") for setting in main] if len(main) > 1 else []
    rows = []
    for scene, measure in [*kinds, *(("all cells", measure) for measure in QUALITY)]:
        chosen = [group for group in groups if scene in (group.scene, "all cells")]
        noise = noise_floor([list(measured(groups, group, measure).values()) for group in chosen])
        if noise is not None:
            numbers = (noise.sd, *(noise.between_means(n) for n in (1, 3, 5)), noise.best_of_five_gain())
            label = {"test.psnr": "PSNR [dB]", "test.ssim_zero_padded": "SSIM"}.get(measure, "LPIPS")
            shown = (f"{number:.{QUALITY[measure] + 1}f}" for number in numbers)
            rows.append([scene, label, str(noise.groups), str(noise.freedom), *shown])
    title = "Noise between seeds under identical settings, pooled, and the difference that it makes 1 time in 20"
    return Table(title, columns, rows, "scene")


def _cost(groups: Groups, main: list[Group]) -> Table:
    measures = {
        "wall clock [s]": ("wall_seconds", 1.0, 0),
        "CPU [s]": ("cpu_seconds", 1.0, 0),
        "Gaussians": ("gaussians", 1.0, 0),
        "peak memory [MiB]": ("peak_rss_mb", 1.0, 0),
        "co-adaptation [1e-3]": ("coadaptation", 1e3, 2),
    }
    rows = []
    for setting in main:
        for method in ordered(group.method for group in groups if group[:3] == setting[:3]):
            group = setting._replace(method=method)
            gap = summarize(paired(measured(groups, group, "train.psnr"), measured(groups, group)))
            row = [_setting(setting), method, str(len(groups[group])), _mean(gap, 2)]
            for measure, scale, decimals in measures.values():
                numbers = [scale * value for value in measured(groups, group, measure).values()]
                row.append(_mean(summarize(numbers), decimals))
            rows.append(row)
    columns = ("method", "n", "PSNR, training less test views [dB]", *measures)
    return Table("Cost, overfitting and co-adaptation: mean (sd) over n seeds", columns, rows, "scene")


def _setting(group: Group) -> str:
    return f"{group.scene}, {group.views} views, {group.start}"


def _mean_of(settings: list[Group], kind: str) -> str:
    names = ", ".join(setting.scene.rpartition("/")[2] for setting in settings)
    return f"mean of {len(settings)} {kind} ({names})"


def _spread(summary: Summary | None) -> tuple[str, str, str]:
    """How many, mean (sd) and best, in dB."""
    return ("0", "-", "-") if summary is None else (str(summary.n), _mean(summary, 2), f"{summary.best:.2f}")


def _mean(summary: Summary | None, decimals: int) -> str:
    return "-" if summary is None else summary.text(decimals)


def _difference(difference: Difference | None) -> str:
    return "-" if difference is None else f"{difference.text(2)} ({difference.pairs})"


def _figures(found: tuple[Figures, ...]) -> str:
    return " or ".join(f"{f.psnr:.2f} / {f.ssim:.3f} / {f.lpips:.3f}" for f in found) or "-"


def _printed(values: tuple[float, ...]) -> str:
    return " or ".join(f"{value:+.2f}" for value in values) or "-"
