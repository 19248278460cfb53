"""The study as a run: it goes on where it stopped, and a folder belongs to one."""

import csv
import json
import shutil

import pytest
from study_rows import tiny_cell

from kgs import DataError
from kgs.study import grid, presets, study


@pytest.mark.slow
def test_it_goes_on_and_reports(tmp_path, monkeypatch, threads, capsys):
    cells = [tiny_cell("off"), tiny_cell("progressive 0.2"), tiny_cell("off", seed=1)]
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: cells[:2])
    study(out=tmp_path, scheduler=threads)
    before = (tmp_path / "sparse.jsonl").read_bytes()
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: cells)
    capsys.readouterr()
    study(out=tmp_path, scheduler=threads)
    assert capsys.readouterr().out.startswith("2 of 3 cells are there")
    content = (tmp_path / "sparse.jsonl").read_bytes()
    assert content.startswith(before)
    done = [json.loads(line)["cell"] for line in content.splitlines()]
    assert sorted(done, key=str) == sorted(cells, key=lambda cell: str(dict(sorted(cell.items()))))
    report = (tmp_path / "sparse.md").read_text(encoding="utf-8")
    assert "kgs study --preset quick -o OUT" in report
    assert "3 of 3 cells" in report
    assert (tmp_path / "index.html").exists()


@pytest.fixture(scope="module")
def studied(tmp_path_factory, threads):
    """The folder of a study of one cell."""
    out = tmp_path_factory.mktemp("studied")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell()])
        study(out=out, scheduler=threads)
    return out


def test_a_study_of_one_cell_is_fitted_measured_and_reported(studied):
    (line,) = (studied / "sparse.jsonl").read_text(encoding="utf-8").splitlines()
    row = json.loads(line)
    assert row["cell"] == tiny_cell()
    result = row["result"]
    assert result["config"]["drop"] == 0.0
    assert result["gaussians"] == sum(result["thresholds"]["gaussians"])
    psnr = result["test"]["psnr"]
    assert 5 < psnr < 40
    assert "1 of 1 cells" in (studied / "sparse.md").read_text(encoding="utf-8")
    (cell,) = csv.DictReader((studied / "sparse.csv").read_text(encoding="utf-8").splitlines())
    assert float(cell["test_psnr"]) == psnr
    page = (studied / "index.html").read_text(encoding="utf-8")
    assert "kgs study --preset quick -o OUT" in page
    assert f"PSNR {psnr:.2f} dB" in page  # the built-in scene is shown


def test_a_report_of_what_is_there_fits_nothing(tmp_path, monkeypatch, threads, studied):
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell()])
    with pytest.raises(DataError, match="expected cells of --preset quick, got none"):
        study(out=tmp_path, report_only=True)
    shutil.copytree(studied, tmp_path, dirs_exist_ok=True)
    cells = (tmp_path / "sparse.jsonl").read_bytes()
    (tmp_path / "sparse.md").unlink()
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell(), tiny_cell(seed=1)])
    assert study(out=tmp_path, report_only=True) == 1  # not all are there
    assert "1 of 2 cells" in (tmp_path / "sparse.md").read_text(encoding="utf-8")
    assert (tmp_path / "sparse.jsonl").read_bytes() == cells


def test_the_report_of_another_preset_is_not_overwritten(tmp_path, monkeypatch, threads, studied):
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell()])
    shutil.copytree(studied, tmp_path, dirs_exist_ok=True)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell("fixed 0.1")])
    with pytest.raises(DataError, match="expected cells of --preset quick"):
        study(out=tmp_path, scheduler=threads)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_second_run_is_refused_and_writes_nothing(tmp_path, monkeypatch, threads, studied):
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell()])
    shutil.copytree(studied, tmp_path, dirs_exist_ok=True)
    for path in tmp_path.iterdir():
        if path.suffix != ".jsonl":
            path.unlink()
    with grid._alone(tmp_path / "sparse.jsonl"), pytest.raises(ValueError, match="expected no other run"):
        study(out=tmp_path, scheduler=threads)
    assert [path.name for path in tmp_path.iterdir()] == ["sparse.jsonl"]


def test_a_cell_that_is_there_twice_counts_once(tmp_path, monkeypatch, threads, studied):
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell()])
    shutil.copytree(studied, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "sparse.jsonl"
    path.write_bytes(2 * path.read_bytes())
    study(out=tmp_path, scheduler=threads)
    assert "1 of 1 cells" in (tmp_path / "sparse.md").read_text(encoding="utf-8")
