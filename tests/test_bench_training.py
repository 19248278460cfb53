"""The grid over the fit's knobs, with the fit itself left out but for one tiny cell."""

import csv
import json

import pytest

from kgs.bench import training
from kgs.bench.training import KNOBS, fit_cell, knob_cells, write_knobs
from kgs.fit.config import FitConfig


def row(seed, psnr, **turned):
    result = {"psnr": psnr, "ssim": 0.5, "train_psnr": 30.0, "cpu_seconds": 10.0, "gaussians": 100}
    return {"cell": {"scene": "s", "seed": seed, **turned}, "result": result}


def test_one_knob_is_turned_at_a_time(monkeypatch, tmp_path):
    (tmp_path / "llff/fern").mkdir(parents=True)
    monkeypatch.setenv("KGS_DATA", str(tmp_path))
    cells = knob_cells()
    assert len(cells) == 2 * 3 * (2 + sum(map(len, KNOBS.values())) + len(KNOBS["backend"]) * len(KNOBS["steps"]))
    default = FitConfig()
    for cell in cells:
        turned = cell.keys() - {"scene", "seed"}
        assert len(turned) <= 1 or turned == {"backend", "steps"}
        assert all(getattr(default, knob) != cell[knob] for knob in turned - {"fast"})


def test_without_scenes_the_built_in_one_is_left(monkeypatch):
    monkeypatch.delenv("KGS_DATA", raising=False)
    assert {cell["scene"] for cell in knob_cells()} == {"synthetic"}


def test_summary_is_mean_and_deviation_over_seeds(tmp_path):
    rows = [row(0, 20.0), row(1, 22.0), row(0, 19.0, drop=0.0), row(1, 21.5, fast=True)]
    text = write_knobs(rows, tmp_path)
    assert "| s | default | 2 | 21.00 (1.41) | 0.00 (0.00) |" in text
    assert "| s | drop 0.0 | 1 | 19.00 | -1.00 |" in text  # against the same seed
    assert "| s | fast | 1 | 21.50 | -0.50 |" in text
    assert text == (tmp_path / "training.md").read_text()
    with (tmp_path / "training.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [(line["knob"], line["n"]) for line in lines] == [("default", "2"), ("drop", "1"), ("fast", "1")]
    assert float(lines[0]["psnr_sd"]) == pytest.approx(2**0.5)
    assert lines[1]["psnr_sd"] == ""
    assert (tmp_path / "training.png").stat().st_size > 1000


def test_each_backend_is_a_curve_of_its_own(monkeypatch, tmp_path):
    drawn, panels = [], training.panels
    monkeypatch.setattr(training, "panels", lambda points, *rest, **axes: drawn.append(points) or panels(points, *rest))
    turned = [
        {},
        {"steps": 500},
        *({"backend": name, **more} for name in ("torch", "numba") for more in ({}, {"steps": 500})),
    ]
    text = write_knobs([row(0, 20.0, **each) for each in turned], tmp_path)
    curves = {label: set(points.value) for label, points in drawn[0].groupby("label")}
    own = {"default", "steps 500"}
    assert curves == {"default": {""}, "steps": {"", "500"}, "torch": own, "numba": own}
    assert "| s | torch steps 500 | 1 | 20.00 |" in text


def test_a_fit_of_a_cell(monkeypatch):
    monkeypatch.setattr(training, "SIZE", (30, 40))
    result = fit_cell({"scene": "synthetic", "seed": 0, "steps": 5, "max_gaussians": 300})
    assert result["curve"][-1]["step"] == 5
    assert result["psnr"] == pytest.approx(result["curve"][-1]["test_psnr"], abs=1e-3)
    assert result["config"]["steps"] == 5
    json.dumps(result)


def test_an_unknown_knob_is_named():
    with pytest.raises(ValueError, match="stepz"):
        fit_cell({"scene": "synthetic", "seed": 0, "stepz": 5})
