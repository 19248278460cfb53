"""The precision benchmark: files, and that errors are where theory puts them."""

from __future__ import annotations

import csv
from dataclasses import asdict

import pytest

from kgs import GaussianRenderer
from kgs.backends import BACKENDS
from kgs.bench import precision
from kgs.bench.precision import DEFAULT, EXACT, EXACT64, KNOBS, SCENES
from kgs.bench.scenes import exact

pytest.importorskip("matplotlib")

pytestmark = pytest.mark.slow  # one run of the whole program


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    out = tmp_path_factory.mktemp("precision")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(precision, "SCENES", {"ordinary": SCENES["ordinary"]})
        for knob in ("tiles 4 to 64", "chunks 4 to 256"):  # of what they change nothing is said here
            patch.setitem(KNOBS, knob, [DEFAULT])
        precision.precision(out=out / "new", quick=True)
    with (out / "new" / "precision.csv").open(newline="") as file:
        return out / "new", list(csv.DictReader(file))


def _row(rows, setting, scene="ordinary"):
    wanted = {name: "" if value is None else str(value) for name, value in asdict(setting).items()}
    (found,) = [row for row in rows if row["scene"] == scene and row.items() >= wanted.items()]
    return {name: float(found[name]) for name in ("max_error", "rmse", "gradient")}


def test_it_writes_tables_and_plots(measured):
    out, _ = measured
    assert (out / "precision.md").read_text().count("| ordinary |") == 1
    for name in ("render", "gradients"):
        assert (out / f"{name}.png").read_bytes()[:4] == b"\x89PNG"


def test_the_marked_default_is_the_renderers():
    options = GaussianRenderer().options
    for name in ("alpha_threshold", "transmittance_stop"):
        assert getattr(DEFAULT, name) == getattr(options, name)
    assert {backend.tile_size for backend in BACKENDS.values()} == {DEFAULT.tile_size}


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


def test_far_from_the_origin_float32_loses_and_float64_does_not():
    scene = SCENES["far origin"](300, 48)
    expected = exact(scene.inputs["float64"], scene.near_plane)[0]
    assert float((scene.image(EXACT) - expected).abs().max()) > 1e-5
    assert float((scene.image(EXACT64) - expected).abs().max()) < 1e-10
