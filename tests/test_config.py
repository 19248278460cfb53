import json
from itertools import pairwise

import pytest

from kgs.fit.config import FitConfig, Recipe, timetable


def test_full_length_is_the_release():
    times = timetable(FitConfig(steps=10_000))
    assert times.sh == (1000, 2000, 3000)
    assert times.densify == tuple(range(600, 10_000, 100))
    assert len(times.densify) == 94
    assert times.reset == (3000, 6000, 9000)


def test_short_fit_scales_counts():
    times = timetable(FitConfig(steps=2000))
    assert times.sh == (200, 400, 600)
    assert times.densify == tuple(range(200, 2000, 100))  # on as much evidence as the recipe, see timetable
    assert times.reset == (600, 1200)
    assert times.evaluate[-1] == 2000


@pytest.mark.parametrize("steps", [1, 7, 100, 999])
def test_densification_is_never_closer_than_ten_steps(steps):
    densify = timetable(FitConfig(steps=steps)).densify
    assert all(later - step >= 10 for step, later in pairwise(densify))


@pytest.mark.parametrize("steps", [500, 2000, 4000, 10_000, 30_000])
def test_a_reset_leaves_time_to_recover(steps):
    times = timetable(FitConfig(steps=steps))
    assert all(end - step >= 200 for step, end in pairwise([*times.reset, steps]))


def test_config_survives_json():
    config = FitConfig(steps=300, drop=0.1, seed=4, recipe=Recipe(dssim_weight=0.3))
    assert FitConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"drop": 1.0}, {"drop": -0.1}, {"sh_degree": 4}, {"evaluations": 0}])
def test_numbers_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        FitConfig(**wrong)


def test_unknown_entry_is_refused():
    with pytest.raises(ValueError, match="FitConfig"):
        FitConfig.from_dict({"stepz": 3})


def test_the_coarse_share_is_counted_in_steps():
    assert timetable(FitConfig(steps=2000)).coarse == 0
    assert timetable(FitConfig(steps=1000, coarse=0.5)).coarse == 500


@pytest.mark.parametrize("name", ["coarse", "growth"])
@pytest.mark.parametrize("value", [1.5, -0.1, float("nan")])
def test_shares_are_from_0_to_1(name, value):
    with pytest.raises(ValueError, match=name):
        FitConfig(**{name: value})
