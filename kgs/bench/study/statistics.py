"""Statistics over seeds and scenes: paired differences with their intervals, and the noise between seeds.

Functions take a table with one row per seed and one column per group; NaN stands where a group lacks a seed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import pandas as pd
from scipy import stats

__all__ = ["BEST_OF_5", "Difference", "Noise", "noise_floor", "paired_difference"]

BEST_OF_5 = 1.163  # how far the best of five runs lies over the mean on average, in standard deviations


class Difference(NamedTuple):
    """Of paired numbers: how many pairs, the mean difference and its 95 % interval (NaN where there is none)."""

    pairs: int
    mean: float
    low: float
    high: float

    def text(self, decimals: int = 2) -> str:
        """As "+0.31 [+0.10, +0.52]"; "+0.31" without an interval, "-" without pairs."""
        if not self.pairs:
            return "-"
        mean, low, high = (f"{round(value, decimals) + 0.0:+.{decimals}f}" for value in self[1:])  # + 0.0: no -0.00
        return mean if math.isnan(self.low) else f"{mean} [{low}, {high}]"


class Noise(NamedTuple):
    """The spread between seeds under identical settings, its degrees of freedom, and how many groups it is from."""

    sd: float
    freedom: int
    groups: int

    def between_means(self, n: int) -> float:
        """What the means of two sets of n seeds differ by at most, 95 times in 100, if the settings do nothing.

        Student's t, as the standard deviation is itself from few numbers. For n = 1: two single runs.
        """
        return float(stats.t.ppf(0.975, self.freedom)) * math.sqrt(2 / n) * self.sd


def noise_floor(groups: pd.DataFrame) -> Noise:
    """The standard deviation within groups: the root mean of their variances, weighted by their degrees of freedom.

    Groups of fewer than two numbers say nothing; NaN of nothing else.
    """
    freedom = (groups.count() - 1).clip(lower=0)
    total = int(freedom.sum())
    variance = float((groups.var() * freedom).sum()) / total if total else math.nan
    return Noise(math.sqrt(variance), total, int((freedom > 0).sum()))


def paired_difference(differences: pd.DataFrame) -> Difference:
    """The mean over scenes of each scene's mean difference, with its 95 % interval.

    The scenes are taken as given, and the seeds as drawn: the interval is Student's t with the variance between seeds
    pooled over the scenes, sum (n_s - 1) degrees of freedom. It says nothing of other scenes. For one scene it is the
    usual interval of paired differences; where no scene has two pairs there is none.
    """
    counts = differences.count()
    counts = counts[counts > 0]
    mean, noise = float(differences.mean().mean()), noise_floor(differences)
    error = noise.sd * math.sqrt((1 / counts).sum()) / max(1, len(counts))
    half = float(stats.t.ppf(0.975, noise.freedom)) * error  # NaN without any freedom
    return Difference(int(counts.sum()), mean, mean - half, mean + half)
