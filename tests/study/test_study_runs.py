"""The study as a run: it goes on where it stopped, and a folder belongs to one."""

import csv
import shutil

import pytest
from study_rows import tiny_cell
from tiny_scenes import write_llff

from kgs import DataError
from kgs.app.files.results import Results
from kgs.datasets import load_scene
from kgs.study import grid, presets
from kgs.study.command import study


@pytest.fixture(scope="module")
def studied(tmp_path_factory, threads):
    """The folder of a study of one cell."""
    out = tmp_path_factory.mktemp("studied")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell()])
        study(out=out, scheduler=threads)
    return out


@pytest.fixture
def folder(tmp_path, studied, monkeypatch):
    """A copy of it, and the same cell wanted."""
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell()])
    return shutil.copytree(studied, tmp_path / "out")


@pytest.fixture
def unchanged(folder):
    """Afterwards the folder is as it was."""
    before = {path: path.read_bytes() for path in folder.iterdir()}
    yield folder
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_study_of_one_cell_is_fitted_measured_and_reported(studied):
    (row,) = grid.read_rows(studied / "sparse.jsonl")
    assert row["cell"] == tiny_cell()
    result = row["result"]
    assert result["config"]["drop"] == 0.0
    assert result["gaussians"] == sum(result["thresholds"]["gaussians"])
    psnr = result["test"]["psnr"]
    assert 5 < psnr < 40
    markdown, table, page = ((studied / name).read_text("utf-8") for name in ("sparse.md", "sparse.csv", "index.html"))
    assert "1 of 1 cells" in markdown
    (cell,) = csv.DictReader(table.splitlines())
    assert float(cell["test_psnr"]) == psnr
    assert "kgs study --preset quick -o OUT" in page
    assert f"PSNR {psnr:.2f} dB" in page  # the built-in scene is shown


def test_a_part_of_a_preset_has_the_same_cells():
    cells = presets.sparse_cells("quick", None)
    part = presets.select(cells, methods=["off", "far"], seeds=[0])
    assert part == [cell for cell in cells if cell["method"] in ("off", "far") and cell["seed"] == 0]
    assert {cell["method"] for cell in part} == {"off", "far"}
    assert presets.select(cells) == cells


def test_other_steps_make_other_cells_that_differ_in_nothing_else():
    cells = presets.sparse_cells("quick", None)
    shorter = presets.with_steps(cells, 30)
    assert not [cell for cell in shorter if cell in cells]
    assert {cell["fit"]["steps"] for cell in shorter} == {30}
    assert presets.with_steps(shorter, 5) == presets.with_steps(cells, 5)


def test_fits_of_other_steps_have_a_folder_of_their_own(unchanged, tmp_path, threads, capsys):
    with pytest.raises(DataError, match="--preset quick --steps 2, got none"):
        study(out=unchanged, scheduler=threads, steps=2)
    assert study(out=tmp_path / "short", scheduler=threads, steps=2) == 0
    assert "off, seed 0: 1 of 2 steps\n" in capsys.readouterr().out  # while it ran
    (row,) = grid.read_rows(tmp_path / "short" / "sparse.jsonl")
    assert row["result"]["config"]["steps"] == 2
    assert "kgs study --preset quick --steps 2 -o OUT" in (tmp_path / "short" / "sparse.md").read_text(encoding="utf-8")


def test_settings_that_a_scene_has_too_few_photos_for_are_left_out_by_name(tmp_path):
    scene = tmp_path / "llff" / "small"
    scene.mkdir(parents=True)
    write_llff(scene)
    count = len(load_scene(scene, photos=False).train)
    said = presets.too_few_photos("paper", tmp_path)
    assert said == [
        f"{scene.relative_to(tmp_path)} with {n} views: it has {count} photos to train on" for n in (3, 6, 9)
    ]
    assert presets.sparse_cells("paper", tmp_path) == []


def test_the_list_says_what_is_done_and_writes_nothing(folder, tmp_path, capsys):
    assert study(out=folder, list_cells=True) == 0
    assert study(out=tmp_path / "nothing", list_cells=True) == 0
    first, _, second, _ = capsys.readouterr().out.splitlines()
    assert first.strip().startswith("done: synthetic")
    assert second.strip().startswith("to do: synthetic")
    assert not (tmp_path / "nothing").exists()


def test_a_part_is_run_and_the_report_is_of_all_that_is_done(folder, monkeypatch, threads):
    other = tiny_cell() | {"seed": 1}
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell(), other])
    assert study(out=folder, scheduler=threads, seeds=(0,)) == 0
    assert len(grid.read_rows(folder / "sparse.jsonl")) == 1
    assert study(out=folder, scheduler=threads, seeds=(1,)) == 0
    assert [row["cell"]["seed"] for row in grid.read_rows(folder / "sparse.jsonl")] == [0, 1]
    assert "2 of 2 cells" in (folder / "sparse.md").read_text(encoding="utf-8")


def test_a_report_of_what_is_there_fits_nothing(folder, tmp_path, monkeypatch):
    with pytest.raises(DataError, match="expected cells of --preset quick, got none"):
        study(out=tmp_path / "new", report_only=True)
    cells = (folder / "sparse.jsonl").read_bytes()
    (folder / "sparse.md").unlink()
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell(), tiny_cell(seed=1)])
    assert study(out=folder, report_only=True) == 1  # not all are there
    assert "1 of 2 cells" in (folder / "sparse.md").read_text(encoding="utf-8")
    assert (folder / "sparse.jsonl").read_bytes() == cells


def test_the_report_of_another_preset_is_not_overwritten(unchanged, monkeypatch, threads):
    monkeypatch.setattr(presets, "sparse_cells", lambda *_: [tiny_cell("fixed 0.1")])
    with pytest.raises(DataError, match="expected cells of --preset quick"):
        study(out=unchanged, scheduler=threads)


def test_a_second_run_is_refused_and_writes_nothing(unchanged, threads):
    with Results.open(unchanged, "study"), pytest.raises(DataError, match="at work"):
        study(out=unchanged, scheduler=threads)


def test_a_cell_that_is_there_twice_counts_once(folder, threads, capsys):
    path = folder / "sparse.jsonl"
    path.write_bytes(2 * path.read_bytes())
    study(out=folder, scheduler=threads)
    assert capsys.readouterr().out.startswith("1 of 1 cells are there")
    assert "1 of 1 cells" in (folder / "sparse.md").read_text(encoding="utf-8")
