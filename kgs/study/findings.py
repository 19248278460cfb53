"""Conclusions of the study: its comparisons as a table and as sentences, and the default's regret."""

from collections.abc import Iterable
from itertools import groupby, product
from operator import itemgetter
from statistics import fmean

import pandas as pd

from kgs.bench.output import mean_sd

from .pairs import LPIPS, PSNR, STARTS, Difference, difference, grouped, main_cells, noise_floor, wide
from .presets import AUTO, AUTO_OFF, FIXED, OFF, PAPER

_EQUAL = (PAPER, FIXED), ("progressive 0.1", "fixed 0.05"), ("progressive 0.3", "fixed 0.15")
_COMPARISONS = {
    f"The default ({AUTO}) over the paper's rule ({PAPER})": ("method", AUTO, PAPER),
    f"The default ({AUTO}) over no dropping (off)": ("method", AUTO, OFF),
    f"Dropping in the default ({AUTO} over {AUTO_OFF})": ("method", AUTO, AUTO_OFF),
    f"The paper's rule ({PAPER}) over no dropping (off)": ("method", PAPER, OFF),
    f"A fixed rate of the same mean ({FIXED}) over no dropping (off)": ("method", FIXED, OFF),
    **{f"A growing rate over the fixed one of the same mean ({a} over {b})": ("method", a, b) for a, b in _EQUAL},
    f"Dense initial points over those of SIFT, both with {PAPER}": ("start", "dense", "sift"),
}
_MEASURES = {PSNR: ("PSNR [dB]", 2), LPIPS: ("LPIPS (less is better)", 3)}
_MEAN = "mean and 95 % intervals"


def headline(frame: pd.DataFrame) -> list[dict[str, str]]:
    """Two lines, PSNR and LPIPS, per comparison that has pairs: the mean over scenes, its intervals, and each scene."""
    main = main_cells(frame, STARTS)
    lines = []
    for (what, (key, value, base)), (measure, (label, decimals)) in product(_COMPARISONS.items(), _MEASURES.items()):
        cells = main[main.start == "dense"] if key == "method" else main[main.method == PAPER]
        gain = difference(cells, key, value, base, measure)
        if not gain.pairs:
            continue
        line = {"": what, "measure": label, _MEAN: gain.text(decimals, labels=True)}
        line |= {"scenes": str(gain.scenes), "pairs": str(gain.pairs), "sd of a pair": mean_sd([gain.sd], decimals)}
        for (scene,), cells_of_scene in grouped(cells, "scene"):
            line[scene] = difference(cells_of_scene, key, value, base, measure).text(decimals)
        lines.append(line)
    return lines


def findings(frame: pd.DataFrame) -> list[str]:
    """The results in sentences, each with its intervals, scenes and pairs; none of cells without pairs."""
    sentences = []
    for what, lines in groupby(headline(frame), itemgetter("")):
        measures = [*lines]
        counts = f"scenes: {measures[0]['scenes']}, pairs: {measures[0]['pairs']}"
        gains = "; ".join(f"{line['measure']} {line[_MEAN]}" for line in measures)
        sentences.append(f"{what}: {gains} ({counts}).")
    best_others = [*_best_others(frame, PSNR)]
    if best_others:
        worst, _, best, gain = min(best_others, key=lambda one: one[-1].mean)
        mean = f"{fmean(one[-1].mean for one in best_others):+.2f} dB in the mean of {len(best_others)} scenes"
        smallest = f"{gain.text(labels=True)} dB on {worst} (over {best})"
        how = "that one is picked after the fact on the same test views, which flatters it"
        sentences.append(f"The default over the best other method of each scene: {mean}, at worst {smallest}; {how}.")
    noise = noise_floor(wide(frame, PSNR))
    if noise.freedom:
        single, three = (f"by up to {noise.between_means(n):.2f} dB" for n in (1, 3))
        runs = f"two single runs differ {single}, and two means of three {three}, 95 times in 100"
        sentences.append(f"Where nothing but the seed differs, {runs} ({noise.groups} groups of runs).")
    return sentences


def regret(frame: pd.DataFrame) -> list[dict[str, str]]:
    """The default against the best other method of each scene, by PSNR and by LPIPS."""
    return [
        {"scene": scene, "measure": label, "best of the others": name, "out of": str(others)}
        | {"the default over it (pairs)": f"{gain.text(decimals)} ({gain.pairs})"}
        for measure, (label, decimals) in _MEASURES.items()
        for scene, others, name, gain in _best_others(frame, measure)
    ]


def _best_others(frame: pd.DataFrame, measure: str) -> Iterable[tuple[str, int, str, Difference]]:
    """Each scene, how many other methods it has, the best of them, and the default over it."""
    for (scene,), cells in grouped(main_cells(frame), "scene"):
        gains = {name: difference(cells, "method", AUTO, name, measure) for name in cells.method.unique()}
        gains = {name: gain for name, gain in gains.items() if gain.pairs}
        sign = -1 if measure == LPIPS else 1
        if gains:
            best = min(gains, key=lambda name: sign * gains[name].mean)
            yield scene, len(gains), best, gains[best]
