"""The grid over the fit's knobs, with the fit itself left out but for one tiny cell."""

import json
import math

import pytest

from kgs.bench import training
from kgs.bench.training import KNOBS, fit_cell, measure_training, summarize, training_cells
from kgs.fit.config import FitConfig


def test_one_knob_is_turned_at_a_time():
    cells = training_cells(["synthetic", "fern"], seeds=3)
    assert len(cells) == 2 * 3 * (2 + sum(map(len, KNOBS.values())))
    default = FitConfig()
    for cell in cells:
        turned = cell.keys() - {"scene", "seed"}
        assert len(turned) <= 1
        assert all(getattr(default, knob) != cell[knob] for knob in turned - {"fast"})


def test_summary_is_mean_and_deviation_over_seeds():
    def row(seed, psnr, **knobs):
        result = {"psnr": psnr, "ssim": 0.5, "train_psnr": 30.0, "cpu_seconds": 10.0, "gaussians": 100}
        return {"cell": {"scene": "s", "seed": seed, **knobs}, "result": result}

    summary = summarize([row(0, 20.0), row(1, 22.0), row(0, 19.0, drop=0.0)])
    assert [(e["knob"], e["n"], e["psnr"]) for e in summary] == [("default", 2, 21.0), ("drop", 1, 19.0)]
    assert summary[0]["psnr_sd"] == pytest.approx(2**0.5)
    assert math.isnan(summary[1]["psnr_sd"])
    assert summary[1]["gain"] == -1.0  # against the same seed


def test_a_fit_of_a_cell(monkeypatch):
    monkeypatch.setattr(training, "SIZE", (30, 40))
    result = fit_cell({"scene": "synthetic", "seed": 0, "steps": 5, "max_gaussians": 300})
    assert result["curve"][-1]["step"] == 5
    assert result["psnr"] == pytest.approx(result["curve"][-1]["test_psnr"], abs=1e-3)
    json.dumps(result)


def test_an_unknown_knob_is_named():
    with pytest.raises(ValueError, match="stepz"):
        fit_cell({"scene": "synthetic", "seed": 0, "stepz": 5})


def test_the_files_are_written(tmp_path, monkeypatch):
    monkeypatch.delenv("KGS_DATA", raising=False)
    result = {"psnr": 20.0, "ssim": 0.5, "train_psnr": 30.0, "cpu_seconds": 10.0, "gaussians": 100}
    monkeypatch.setattr(
        training, "run_grid", lambda cells, *_, **__: [{"cell": cell, "result": result} for cell in cells]
    )
    rows = measure_training(tmp_path, say=lambda _: None)
    assert {row["cell"]["scene"] for row in rows} == {"synthetic"}
    assert "| synthetic | default | 3 | 20.00 (0.00)" in (tmp_path / "training.md").read_text()
    assert (tmp_path / "training.png").stat().st_size > 1000
