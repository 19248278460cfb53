"""The precision benchmark: files, and that errors are where theory puts them."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import asdict

import numpy as np
import pytest
import torch

from kgs import GaussianRenderer
from kgs.bench import precision
from kgs.bench.precision import DEFAULT, EXACT, EXACT64, KNOBS, NODES, SCENES, measure_precision

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    out = tmp_path_factory.mktemp("precision")
    lines = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(precision, "SCENES", {name: SCENES[name] for name in ("ordinary", "far origin")})
        result = measure_precision(out, quick=True, say=lines.append)
    return out, result, lines


def _row(result, setting, scene="ordinary"):
    found = [r for r in result["rows"] if r["scene"] == scene and r.items() >= asdict(setting).items()]
    assert len(found) == 1
    return found[0]


def test_it_writes_tables_plots_and_progress(measured):
    out, result, lines = measured
    assert json.loads((out / "precision.json").read_text())["rows"] == result["rows"]
    assert (out / "precision.md").read_text() == lines[-1]
    assert lines[:2] == ["ordinary ...", "far origin ..."]
    for name, rows in (("precision", result["rows"]), ("projection", result["projection"])):
        with (out / f"{name}.csv").open(newline="") as file:
            assert len(list(csv.DictReader(file))) == len(rows)
    for name in ("render", "gradients", "projection"):
        assert (out / f"{name}.png").read_bytes()[:4] == b"\x89PNG"


def test_the_marked_default_is_the_renderers():
    renderer = GaussianRenderer()
    for name in ("alpha_threshold", "transmittance_stop", "tile_size"):
        assert getattr(DEFAULT, name) == getattr(renderer, name)


@pytest.mark.parametrize("error", ["max_error", "rmse", "gradient"])
@pytest.mark.parametrize("knob", [name for name in KNOBS if name.startswith(("alpha", "stop"))])
def test_errors_grow_with_the_thresholds(measured, knob, error):
    found = [_row(measured[1], setting)[error] for setting in KNOBS[knob]]
    assert found == sorted(found)
    assert found[-1] > 10 * found[0]


def test_the_stop_alone_costs_no_more_light_than_it_says(measured):
    for setting in KNOBS["stop 0 to 1e-2, alpha threshold 0"]:
        assert _row(measured[1], setting)["max_error"] <= 1.2 * setting.transmittance_stop + 5e-6  # colours up to 1.1


def test_exact_thresholds_leave_rounding_alone(measured):
    exact64, exact32 = _row(measured[1], EXACT64), _row(measured[1], EXACT)
    assert exact64["max_error"] < 1e-12
    assert exact64["gradient"] < 1e-10
    assert exact32["max_error"] < 5e-6
    assert exact32["gradient"] < 1e-4
    assert exact32["rmse"] <= exact32["max_error"]


def test_far_from_the_origin_float32_loses_and_float64_does_not(measured):
    assert _row(measured[1], EXACT, "far origin")["max_error"] > 1e-5
    assert _row(measured[1], EXACT64, "far origin")["max_error"] < 1e-10


def test_tiles_and_chunks_do_not_change_the_image(measured):
    flat = measured[1]["flatness"]["ordinary"]
    assert flat["tiles 4 to 16, exact"] <= 1e-6
    assert flat["chunks 4 to 256, exact"] <= 1e-6
    assert flat["tiles 4 to 64, exact"] <= 5e-5  # the tile's polynomial loses digits with the square of its side


def test_the_first_order_footprint_errs_with_the_square_of_its_angle(measured):
    rows = [r for r in measured[1]["projection"] if r["sigma_over_z"] <= 0.1]
    for angle in (0, 20, 40, 55):
        of = [r for r in rows if r["angle"] == angle]
        x = np.log([r["sigma_over_z"] for r in of])
        assert np.polyfit(x, np.log([r["covariance_error"] for r in of]), 1)[0] == pytest.approx(2, abs=0.1)
        if angle:
            assert np.polyfit(x, np.log([r["mean_error_sigmas"] for r in of]), 1)[0] == pytest.approx(1, abs=0.1)
    assert max(r["quadrature_change"] for r in rows) < 1e-2


@pytest.mark.parametrize("sigma", [1e-3, 1e-2, 0.1])
def test_the_moments_on_the_axis_are_those_of_the_series(sigma):
    # on the axis E[(x / z)^2] = sigma^2 E[z^-2], E[z^-2] = 1 + 3 sigma^2 + 15 sigma^4 + 105 sigma^6 + ...
    _, covariance = precision._moments(torch.tensor([0.0, 0.0, 1.0]).double(), sigma, NODES)
    series = sum(math.prod(range(1, 2 * k + 2, 2)) * sigma ** (2 * k) for k in range(5))
    assert float(covariance[0, 0]) == pytest.approx(sigma**2 * series, rel=1e-5)
    assert float(covariance[0, 1]) == pytest.approx(0, abs=1e-18)
