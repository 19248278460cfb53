"""Statistics over seeds and scenes: paired differences with their intervals, and the noise between seeds.

Tables have one row per seed and one column per group; NaN stands where a group lacks a seed.
"""

import math
from typing import NamedTuple

import pandas as pd
from scipy import stats

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

    The scenes are taken as given, the seeds as drawn: Student's t with the variance between seeds pooled over the
    scenes, sum (n_s - 1) degrees of freedom. There is no interval where no scene has two pairs.
    """
    counts = differences.count()
    counts = counts[counts > 0]
    mean, noise = float(differences.mean().mean()), noise_floor(differences)
    error = noise.sd * math.sqrt((1 / counts).sum()) / max(1, len(counts))
    half = float(stats.t.ppf(0.975, noise.freedom)) * error
    return Difference(int(counts.sum()), mean, mean - half, mean + half)
