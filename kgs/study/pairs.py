"""The cells of the study as one table, and statistics of their pairs: means, intervals and noise."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import pandas as pd
from scipy import stats

from kgs._support.errors import ArgumentError
from kgs.metrics.evaluate import MEASURES

from .presets import METHODS, SCENES
from .texts import interval, signed

KEYS = ("scene", "views", "start", "method")  # equal for cells that differ only in the seed
COLUMNS = [f"{part}.{name}" for part in ("test", "train") for name in MEASURES]
COLUMNS += ["init.points", "init.seconds", "gaussians", "wall_seconds", "cpu_seconds", "peak_rss_mb", "coadaptation"]
ORIGIN = ["revision", "date", "versions.machine"]
_OTHERS = ["init.kind", "curve", *(f"thresholds.{key}" for key in ("distance", "gaussians", "over")), *ORIGIN]
_OTHERS += [f"protocol.{key}" for key in ("train", "test", "image_size")]
STARTS = ("sift", "random", "model-points", "dense", "scene")
PSNR = "test.psnr"
LPIPS = "test.lpips_vgg_unscaled"


class Difference(NamedTuple):
    """A mean difference, its 95 % intervals, the standard deviation of a pair (NaN if unknown), and how many scenes."""

    pairs: int
    mean: float
    low: float  # over seeds
    high: float
    sd: float = math.nan
    scenes: int = 1
    over_scenes: tuple[float, float] = (math.nan, math.nan)

    def text(self, decimals: int = 2, *, labels: bool = False) -> str:
        """As "+0.31 [+0.10, +0.52]"; an interval that is not known is left out, and "-" stands for no pairs.

        Of several scenes as "+0.31 [-0.20, +0.82] over scenes, [+0.10, +0.52] over seeds"; `labels`: of one, too.
        """
        if not self.pairs:
            return "-"
        labels = labels or self.scenes > 1
        intervals = []
        for label, limits in {" over scenes": self.over_scenes, " over seeds": (self.low, self.high)}.items():
            if not math.isnan(limits[0]):
                intervals.append(interval(limits, decimals) + (label if labels else ""))
        return f"{signed(self.mean, decimals)} {', '.join(intervals)}".rstrip()


class Noise(NamedTuple):
    """The standard deviation between seeds under equal settings, its degrees of freedom, and from how many groups."""

    sd: float
    freedom: int
    groups: int

    def between_means(self, n: int) -> float:
        """What two means of n seeds differ by at most, 95 times in 100, if the settings do nothing (Student's t)."""
        return _half_interval(self.freedom, math.sqrt(2 / n) * self.sd)


def noise_floor(groups: pd.DataFrame) -> Noise:
    """The root of the groups' mean variance, weighted by degrees of freedom; NaN if no group has two numbers."""
    freedom = (groups.count() - 1).clip(lower=0)
    total = int(freedom.sum())
    variance = float((groups.var() * freedom).sum()) / total if total else math.nan
    return Noise(math.sqrt(variance), total, int((freedom > 0).sum()))


def paired_difference(differences: pd.DataFrame) -> Difference:
    """The mean over scenes (columns) of each scene's mean difference over seeds (rows), with two 95 % intervals.

    Over seeds the scenes are taken as given: Student's t with the variance between seeds pooled over scenes. It holds
    for these scenes. Over scenes they are taken as drawn from all of their kind: Student's t over the scenes' means,
    k - 1 degrees of freedom for k scenes; none for a single one.
    """
    differences = differences.dropna(axis="columns", how="all")
    counts = differences.count()  # pairs of each scene
    means = differences.mean()
    k = len(means)
    mean = float(means.mean())
    noise = noise_floor(differences)
    by_seeds = _half_interval(noise.freedom, noise.sd * math.sqrt((1 / counts).sum()) / max(1, k))
    by_scenes = _half_interval(k - 1, float(means.std()) / math.sqrt(max(1, k)))
    over_scenes = (mean - by_scenes, mean + by_scenes)
    pairs = int(counts.sum())
    return Difference(pairs, mean, mean - by_seeds, mean + by_seeds, noise.sd, k, over_scenes)


def _half_interval(freedom: int, error: float) -> float:
    """Half of the 95 % interval of Student's t; NaN without a degree of freedom."""
    return float(stats.t.ppf(0.975, freedom)) * error


def frame_of(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> pd.DataFrame:
    """One line per row: the fields of its cell, and these of its result, as "test.psnr"; NaN where it has none."""
    results = pd.json_normalize([row["result"] for row in rows]).reindex(columns=[*columns])
    return pd.DataFrame([row["cell"] for row in rows]).join(results)


def cells_frame(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """One line per cell, by scene; ValueError: no rows, or two that differ in the fit's settings or size alone."""
    if not rows:
        raise ArgumentError("rows", "at least one cell", "none")
    frame = frame_of(rows, COLUMNS + _OTHERS)
    frame[COLUMNS] = frame[COLUMNS].astype(float).where(lambda numbers: numbers.abs() < math.inf)
    twice = frame.loc[frame.duplicated([*KEYS, "seed"]), [*KEYS, "seed"]].to_numpy()
    if len(twice):
        *group, seed = twice[0]
        raise ArgumentError("rows", f"one cell for each seed of {tuple(group)}", f"two for {seed}")
    order = {name: k for k, name in enumerate([*frame.scene.unique(), *STARTS, *METHODS])}

    def rank(column: "pd.Series[Any]") -> "pd.Series[Any]":
        return column if column.name == "views" else column.map(order).fillna(len(order))

    return frame.sort_values([*KEYS], key=rank)


def with_measures(cells: pd.DataFrame) -> pd.DataFrame:
    """With "gap", the PSNR of training less that of test views in dB, and "thousandths" of co-adaptation."""
    return cells.assign(gap=cells["train.psnr"] - cells[PSNR], thousandths=1e3 * cells.coadaptation)


def grouped(frame: pd.DataFrame, *keys: str) -> Iterable[tuple[Any, pd.DataFrame]]:
    """The cells grouped by these fields, in order of appearance; each group comes with its tuple of values."""
    return frame.groupby(list(keys), sort=False)


def wide(frame: pd.DataFrame, measure: str, **fixed: str) -> pd.DataFrame:
    """A measure of the cells with these fields: one row per seed, one column per group of the other fields."""
    for key, value in fixed.items():
        frame = frame[frame[key] == value]
    return frame.pivot(index="seed", columns=[key for key in KEYS if key not in fixed], values=measure)


def difference(frame: pd.DataFrame, key: str, value: str, base: str, measure: str = PSNR) -> Difference:
    """Of cells that differ in one field alone, the method or the start: the mean of value less base."""
    if value == base or not {value, base} <= set(frame[key]):
        return paired_difference(pd.DataFrame())
    return paired_difference(wide(frame, measure, **{key: value}) - wide(frame, measure, **{key: base}))


def main_cells(frame: pd.DataFrame, starts: Sequence[str] = ("dense",)) -> pd.DataFrame:
    """The cells of each scene's main setting: as many views as `SCENES` has; else the fewest from dense points."""
    views = {}
    for (scene,), cells in grouped(frame[frame.start == "dense"], "scene"):
        views[scene] = SCENES[scene] if SCENES.get(scene) in {*cells.views} else cells.views.min()
    return frame[(frame.views == frame.scene.map(views)) & frame.start.isin(starts)]
