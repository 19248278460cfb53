"""`--minutes`: the number of steps follows from the time, and from then on it is a fit of that many steps."""

import time
from dataclasses import replace

import pytest
import torch

from kgs import DataError
from kgs.fit import FitConfig, Trainer, fit_scene
from kgs.fit.checkpoint import load_checkpoint
from kgs.fit.config import FAST, Recipe
from kgs.fit.minutes import expected_minutes, steps_within
from kgs.fit.run import choose_points
from kgs.io.json_files import read_json
from kgs.io.results_folder import CHECKPOINT

# The time ends with the last step.
CONFIG = FitConfig(minutes=0.1, init="random", init_points=60, keep_all=True, recipe=Recipe(grad_threshold=1e-5))


@pytest.fixture
def clock(monkeypatch):
    """Time that passes with steps, by the number of Gaussians and pixels, and with renders alone."""
    now, step, psnr = [100.0], Trainer._descend, Trainer.psnr

    def slow_step(self):
        now[0] += (0.01 + 1e-5 * len(self.model)) * (0.3 if self.step < self.times.coarse else 1.0)
        return step(self)

    def slow_psnr(self, views):
        now[0] += 0.01 * len(views)
        return psnr(self, views)

    monkeypatch.setattr(Trainer, "_descend", slow_step)
    monkeypatch.setattr(Trainer, "psnr", slow_psnr)
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    return now


@pytest.mark.parametrize("config", [CONFIG, replace(CONFIG, minutes=0.04, coarse=0.9, growth=0.8, max_gaussians=400)])
def test_the_time_is_kept_within_a_tenth_and_the_steps_are_stored(clock, scene, tmp_path, config):
    begun = clock[0]
    metrics, _ = fit_scene(scene, config, tmp_path)
    assert abs((clock[0] - begun) / (60 * config.minutes) - 1) <= 0.1
    assert metrics["gaussians"] > 60
    steps = metrics["steps"]
    assert read_json(tmp_path / "config.json")["fit"]["steps"] == steps
    assert load_checkpoint(tmp_path / CHECKPOINT)["config"]["steps"] == steps
    whole = Trainer(scene, replace(config, minutes=None, steps=steps), choose_points(scene, config))
    whole.fit()
    resumed = Trainer.resume(scene, config, tmp_path / CHECKPOINT)
    assert resumed.config.steps == steps
    for one, other in zip(whole.model.parameters(), resumed.model.parameters(), strict=True):
        assert torch.equal(one, other)


def test_a_resumed_fit_keeps_its_steps_however_fast_the_machine_is_now(scene, points, tmp_path):
    first = Trainer(scene, replace(CONFIG, steps=7), points)
    first.train_step()
    first.save(tmp_path / CHECKPOINT)
    assert Trainer.resume(scene, CONFIG, tmp_path / CHECKPOINT).config.steps == 7
    assert Trainer.resume(scene, replace(CONFIG, minutes=None, steps=7), tmp_path / CHECKPOINT).config.steps == 7
    with pytest.raises(DataError, match=r"--minutes: expected 0\.1, as the fit was begun with, got 5\.0"):
        Trainer.resume(scene, replace(CONFIG, minutes=5.0), tmp_path / CHECKPOINT)
    with pytest.raises(DataError, match="--steps: expected 7, as the fit was begun with, got 8"):
        Trainer.resume(scene, replace(CONFIG, minutes=None, steps=8), tmp_path / CHECKPOINT)


def test_there_is_one_step_where_the_time_is_over(clock, scene, points):
    assert steps_within(scene, replace(FAST, minutes=1e-9), points, clock[0]) == 1


@pytest.mark.parametrize("minutes", [0.0, -1.0, float("nan"), float("inf"), "5", True])
def test_minutes_are_a_number_above_zero(minutes):
    with pytest.raises(ValueError, match=r"minutes: expected a finite number in \(0, 1000000\]"):
        FitConfig(minutes=minutes)


def test_the_time_of_a_fit_is_foretold():
    config = FitConfig(steps=2000, backend="torch")
    small, large = expected_minutes(252 * 189, config), expected_minutes(504 * 378, config)
    assert 1 < small < large < 4 * small  # a step costs something for each Gaussian, too
    assert expected_minutes(504 * 378, replace(config, steps=1000)) == pytest.approx(large / 2)
    pytest.importorskip("numba")
    assert expected_minutes(504 * 378, replace(config, backend="numba")) < large / 2
