"""Conclusions of the study: its comparisons as a table and as sentences."""

from itertools import groupby, product
from operator import itemgetter

import pandas as pd

from kgs.bench.output import mean_sd

from .pairs import LPIPS, PSNR, STARTS, difference, grouped, main_cells, noise_floor, wide
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
    noise = noise_floor(wide(frame, PSNR))
    if noise.freedom:
        single, three = (f"by up to {noise.between_means(n):.2f} dB" for n in (1, 3))
        runs = f"two single runs differ {single}, and two means of three {three}, 95 times in 100"
        sentences.append(f"Where nothing but the seed differs, {runs} ({noise.groups} groups of runs).")
    return sentences
