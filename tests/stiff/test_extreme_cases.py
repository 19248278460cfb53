"""The table of extremes: every bound is met, and a miss is seen."""

import csv
import json
import math

import pytest

from kgs.bench import extremes
from kgs.bench.extreme_cases import CASES, Case, ordinary
from kgs.bench.extremes import measure_extremes


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    out, lines = tmp_path_factory.mktemp("extremes"), []
    return out, measure_extremes(out, quick=True, say=lines.append), lines


def test_every_bound_is_met(measured):
    assert [(row["case"], row["dtype"]) for row in measured[1]["rows"] if row["verdict"] != "met"] == []
    assert measured[1]["missed"] == 0
    assert all(math.isfinite(row["forward"]) and math.isfinite(row["gradient"]) for row in measured[1]["rows"])


def test_files_and_lines(measured):
    out, result, lines = measured
    assert json.loads((out / "extremes.json").read_text())["rows"] == result["rows"]
    with (out / "extremes.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(result["rows"]) == 2 * (len(CASES) + 6)
    assert all(case.name in (out / "extremes.md").read_text() for case in CASES)
    assert lines[-1] == f"0 of {len(result['rows'])} bounds are missed"


def test_a_missed_bound_and_the_time_are_shown(tmp_path, monkeypatch):
    strict = {"float32": (1e-9, 1e-5), "float64": (1e-13, 1e-12)}
    monkeypatch.setattr(extremes, "CASES", [Case("strict", "all", "none", lambda: ordinary(20), strict)])
    monkeypatch.setattr(extremes, "_IDENTITIES", {"differs": ("all", "none", lambda _: 1e-9)})
    result = measure_extremes(tmp_path, say=lambda _: None)
    assert [row["verdict"] for row in result["rows"]] == ["MISSED", "met", "MISSED", "MISSED"]
    assert result["missed"] == 3
    assert result["rows"][0]["time"] > 0
    assert (tmp_path / "extremes.md").read_text().count("MISSED") == 2


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_never_counts_as_equal(value):
    image, gradients = extremes._render(ordinary(5), extremes.DTYPES["float64"])
    spoilt = image.clone()
    spoilt[0, 0, 0, 0] = value
    assert extremes._largest_difference((spoilt, gradients), (spoilt, gradients)) == math.inf
