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
    lines, main = [], main_cells(frame, STARTS)
    for (what, (key, value, base)), (measure, (label, decimals)) in product(_COMPARISONS.items(), _MEASURES.items()):
        cells = main[main.start == "dense"] if key == "method" else main[main.method == PAPER]
        if (found := difference(cells, key, value, base, measure)).pairs:
            line = {"": what, "measure": label, _MEAN: found.text(decimals, labels=True), "scenes": str(found.scenes)}
            line |= {"pairs": str(found.pairs), "sd of a pair": mean_sd([found.sd], decimals)}
            for (scene,), some in grouped(cells, "scene"):
                line[scene] = difference(some, key, value, base, measure).text(decimals)
            lines.append(line)
    return lines


def findings(frame: pd.DataFrame) -> list[str]:
    """The results in sentences, each with its intervals, scenes and pairs; none of cells without pairs."""
    sentences = []
    for what, lines in groupby(headline(frame), itemgetter("")):
        first, *others = lines
        counts = f"scenes: {first['scenes']}, pairs: {first['pairs']}"
        measures = "; ".join(f"{line['measure']} {line[_MEAN]}" for line in (first, *others))
        sentences.append(f"{what}: {measures} ({counts}).")
    if found := [*_best_others(frame, PSNR)]:
        worst, _, best, gain = min(found, key=lambda one: one[-1].mean)
        mean = f"{fmean(one[-1].mean for one in found):+.2f} dB in the mean of {len(found)} scenes"
        least = f"{gain.text(labels=True)} dB on {worst} (over {best})"
        how = "that one is picked after the fact on the same test views, which flatters it"
        sentences.append(f"The default over the best other method of each scene: {mean}, at worst {least}; {how}.")
    if (noise := noise_floor(wide(frame, PSNR))).freedom:
        single, three = (f"{noise.between_means(n):.2f} dB" for n in (1, 3))
        what = f"two single runs differ by up to {single}, and two means of three by up to {three}, 95 times in 100"
        sentences.append(f"Where nothing but the seed differs, {what} ({noise.groups} groups of runs).")
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
        sign = -1 if measure == LPIPS else 1
        if others := {name: sign * gain.mean for name, gain in gains.items() if gain.pairs}:
            best = min(others, key=others.__getitem__)
            yield scene, len(others), best, gains[best]
