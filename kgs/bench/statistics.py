"""Statistics over seeds and scenes: spread, paired differences with their intervals, and the noise between seeds.

Source: Student's distribution in closed form for whole degrees of freedom, M. Abramowitz and I. Stegun, "Handbook of
Mathematical Functions", 26.7.3 and 26.7.4.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

__all__ = [
    "Difference",
    "Group",
    "Noise",
    "Summary",
    "average_over_scenes",
    "by_seed",
    "group_cells",
    "noise_floor",
    "paired",
    "paired_difference",
    "student_quantile",
    "summarize",
]

BEST_OF_5 = 1.163  # expected largest of five standard normal numbers


class Group(NamedTuple):
    """What cells have in common that differ in the seed alone."""

    scene: str
    views: int
    start: str
    method: str


class Summary(NamedTuple):
    """Of n numbers: their mean, sample standard deviation (None for one number) and the best."""

    n: int
    mean: float
    sd: float | None
    best: float

    def text(self, decimals: int) -> str:
        """As "24.31 (0.12)", mean and standard deviation; "24.31" without one."""
        return f"{self.mean:.{decimals}f}" + ("" if self.sd is None else f" ({self.sd:.{decimals}f})")


class Difference(NamedTuple):
    """Of paired numbers: how many pairs, the mean difference and its 95 % interval (None where there is none)."""

    pairs: int
    mean: float
    low: float | None
    high: float | None

    def text(self, decimals: int) -> str:
        """As "+0.31 [+0.10, +0.52]"; "+0.31" without an interval."""
        mean = _signed(self.mean, decimals)
        if self.low is None or self.high is None:
            return mean
        return f"{mean} [{_signed(self.low, decimals)}, {_signed(self.high, decimals)}]"


class Noise(NamedTuple):
    """The spread between seeds under identical settings, and the degrees of freedom and groups it is from."""

    sd: float
    freedom: int
    groups: int

    def between_means(self, n: int) -> float:
        """What the means of two sets of n seeds differ by at most, 95 times in 100, if the settings do nothing.

        Student's t, as the standard deviation is itself from few numbers. For n = 1: two single runs.
        """
        return student_quantile(self.freedom) * math.sqrt(2 / n) * self.sd

    def best_of_five_gain(self) -> float:
        """How far the best of five runs lies over the mean on average."""
        return BEST_OF_5 * self.sd


def group_cells(rows: Iterable[Mapping[str, Any]]) -> dict[Group, dict[int, dict[str, Any]]]:
    """The results by seed of each group, in the order of the rows.

    Args:
        rows: dicts of "cell" and "result".

    Raises:
        ValueError: two cells differ in nothing but their fits' settings or size: those belong in two reports.
    """
    groups: dict[Group, dict[int, dict[str, Any]]] = {}
    for row in rows:
        cell = row["cell"]
        group = Group(cell["scene"], cell["views"], cell["start"], cell["method"])
        results = groups.setdefault(group, {})
        if cell["seed"] in results:
            raise ValueError(f"rows: expected one cell for each seed of {tuple(group)}, got two for {cell['seed']}")
        results[cell["seed"]] = row["result"]
    return groups


def by_seed(results: Mapping[int, Mapping[str, Any]], measure: str) -> dict[int, float]:
    """A number of each seed's result, in the seeds' order, where it is there and finite.

    Args:
        results: by seed.
        measure: where it stands: "cpu_seconds", or "test.psnr" for an entry of an entry.
    """
    found = {}
    for seed in sorted(results):
        value: Any = results[seed]
        for key in measure.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
        if value is not None and math.isfinite(value):
            found[seed] = float(value)
    return found


def summarize(values: Iterable[float], *, lower_is_better: bool = False) -> Summary | None:
    """Mean, sample standard deviation and best; None of no numbers."""
    numbers = list(values)
    if not numbers:
        return None
    spread = statistics.stdev(numbers) if len(numbers) > 1 else None
    return Summary(len(numbers), statistics.fmean(numbers), spread, (min if lower_is_better else max)(numbers))


def paired(values: Mapping[int, float], base: Mapping[int, float]) -> list[float]:
    """Value less base of each seed that both have."""
    return [values[seed] - base[seed] for seed in sorted(values.keys() & base.keys())]


def paired_difference(scenes: Iterable[Sequence[float]]) -> Difference | None:
    """The mean over scenes of each scene's mean difference, with its 95 % interval.

    The scenes are taken as given, and the seeds as drawn: the interval is Student's t with the variance between seeds
    pooled over the scenes, sum (n_s - 1) degrees of freedom. It says nothing of other scenes. For one scene it is the
    usual interval of paired differences; where no scene has two pairs there is none.

    Args:
        scenes: the differences of each scene's pairs; scenes without any do not count.
    """
    counted = [list(differences) for differences in scenes if len(differences)]
    if not counted:
        return None
    pairs = sum(map(len, counted))
    mean = statistics.fmean(statistics.fmean(differences) for differences in counted)
    noise = noise_floor(counted)
    if noise is None:
        return Difference(pairs, mean, None, None)
    error = noise.sd * math.sqrt(sum(1 / len(differences) for differences in counted)) / len(counted)
    half = student_quantile(noise.freedom) * error
    return Difference(pairs, mean, mean - half, mean + half)


def average_over_scenes(scenes: Sequence[Mapping[int, float]]) -> dict[int, float]:
    """The mean over scenes by seed, of the seeds that all scenes have."""
    common = set(scenes[0]).intersection(*scenes[1:]) if scenes else set()
    return {seed: statistics.fmean(values[seed] for values in scenes) for seed in sorted(common)}


def noise_floor(groups: Iterable[Sequence[float]]) -> Noise | None:
    """The standard deviation within groups: root mean of their variances, weighted by their degrees of freedom.

    Args:
        groups: numbers under identical settings; groups of fewer than two say nothing. None where all are such.
    """
    repeated = [values for values in groups if len(values) > 1]
    freedom = sum(len(values) - 1 for values in repeated)
    if not freedom:
        return None
    squares = sum((len(values) - 1) * statistics.variance(values) for values in repeated)
    return Noise(math.sqrt(squares / freedom), freedom, len(repeated))


def student_quantile(freedom: int, confidence: float = 0.95) -> float:
    """The t that a Student variable stays within, in absolute value, with this probability.

    Args:
        freedom: degrees of freedom, a whole number of at least 1.
        confidence: in (0, 1).

    Raises:
        ValueError: one is outside these.
    """
    if freedom < 1:
        raise ValueError(f"freedom: expected at least 1, got {freedom}")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence: expected a probability in (0, 1), got {confidence}")
    low, high = 0.0, math.pi / 2
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _student_probability(middle, freedom) < confidence else (low, middle)
    return math.sqrt(freedom) * math.tan(low)


def _signed(value: float, decimals: int) -> str:
    return f"{round(value, decimals) + 0.0:+.{decimals}f}"  # no -0.00


def _student_probability(angle: float, freedom: int) -> float:
    """Probability of |t| < sqrt(freedom) tan(angle)."""
    cosine, odd = math.cos(angle), freedom % 2
    term, total = (cosine, 0.0) if odd else (1.0, 0.0)
    for k in range(odd, freedom - 1, 2):
        total += term
        term *= cosine**2 * (k + 1) / (k + 2)
    return 2 / math.pi * (angle + math.sin(angle) * total) if odd else math.sin(angle) * total
