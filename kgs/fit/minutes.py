"""How many steps a fit can do in a given time: a fit in miniature says so, which is thrown away."""

import time
from bisect import bisect_right
from dataclasses import replace

import numpy as np

from kgs.backends import resolve
from kgs.datasets.scene import Scene
from kgs.init_points import FirstPoints
from kgs.machine import check_device

from .config import FitConfig, Timetable, most_gaussians, timetable
from .trainer import Trainer

_SHARE, _FEWEST = 0.04, 20  # of the steps in the miniature, and how many at least
_MOST = 10_000_000  # steps of a fit
_FIRST = 3  # steps that are not timed: kernels are compiled or loaded, memory is fetched
_STEP, _PIXEL = 0.025, 1.5e-7  # seconds of a step with 20 000 to 30 000 Gaussians, on two cores of an AMD EPYC
_TORCH = 4.0  # times as long as the compiled backend


def expected_minutes(pixels: int, config: FitConfig) -> float:
    """What the steps of a fit take on a CPU, known before it begins, within a factor of two: photos of `pixels`."""
    slower = 1.0 if resolve(config.backend, check_device(config.device)) == "numba" else _TORCH
    return slower * config.steps * (_STEP + _PIXEL * pixels) / 60


def steps_within(scene: Scene, config: FitConfig, points: FirstPoints, begun: float) -> int:
    """The number of steps with which a fit ends `config.minutes` after `begun`, its curve included.

    The miniature does at each share of its steps what the whole fit does there: harmonics, pictures, densification and
    resets. A fit of fewer steps than it stands for may have fewer Gaussians; what that saves follows from the line
    through the times of its steps by their number.

    Args:
        scene: posed training and test views.
        config: with `minutes`; its `steps` do not count.
        points: where the Gaussians begin.
        begun: when the time began, by `time.perf_counter`.
    """
    end, config = begun + 60.0 * (config.minutes or 0.0), replace(config, minutes=None, steps=2 * _FIRST)

    def most(steps: int) -> int:
        return most_gaussians(replace(config, steps=max(1, steps)), len(points.points))

    trial = Trainer(scene, replace(config, evaluations=1, coarse=0.0), points)
    trial.fit(lambda trainer, _: trainer.step == _FIRST)
    seconds = trial.seconds
    trial.fit(lambda trainer, _: trainer.step == 2 * _FIRST - 1)  # the last step measures the curve
    guess = round((end - time.perf_counter()) / (trial.seconds - seconds) * (_FIRST - 1))
    guess = min(_MOST, max(_FEWEST, guess))
    count, start, found = max(_FEWEST, round(_SHARE * guess)), time.perf_counter(), list[tuple[float, int]]()
    small = Trainer(scene, replace(config, steps=count, max_gaussians=most(guess)), points)
    small.times = _scaled(timetable(replace(config, steps=guess)), count / guess)

    def note(trainer: Trainer, _: float) -> bool:
        found.append((trainer.seconds, len(trainer.model)))
        return False

    small.fit(note)
    now = time.perf_counter()
    times, counts = np.diff([each for each, _ in found], prepend=0.0), np.array([n for _, n in found], float)
    slope, level = np.polyfit(counts, times, 1) if np.ptp(counts) else (0.0, 1.0)
    rise = max(0.0, slope) / max(level, 1e-9)

    def seconds_of(steps: int) -> float:
        saved = (1 + rise * np.minimum(counts, most(steps))) / (1 + rise * counts)
        return float(steps * (times * saved).mean())

    left = end - now - (now - start - small.seconds)  # the curve takes as long again
    return max(1, bisect_right(range(_MOST + 1), left, key=seconds_of) - 1)


def _scaled(times: Timetable, share: float) -> Timetable:
    """The same shares of fewer steps."""
    sh, densify, reset, evaluate = (tuple(max(1, round(share * step)) for step in steps) for steps in times[:4])
    return Timetable(sh, densify, reset, evaluate, round(share * times.coarse))
