"""The paper's tables as parts of its preset."""

from itertools import product

import pytest

from kgs.study import presets
from kgs.study.command import study
from kgs.study.published import PUBLISHED, TABLES, cells_of_table, published

RATES = [f"{schedule} {rate}" for schedule in ("progressive", "fixed") for rate in (0.1, 0.2, 0.3)]
PENALTIES = [f"L1 {by} {weight}" for by in ("gradient", "distance") for weight in (0.001, 0.01)]
SCENES = ("llff/fern", "llff/mine", "colmap/kitchen", "colmap/trex", "blender/lego", "nerfstudio/fox")


@pytest.fixture
def data(tmp_path):
    """Folders of scenes, the cells of which count as having photos enough."""
    for scene in SCENES:
        (tmp_path / scene).mkdir(parents=True)
    return tmp_path


@pytest.mark.parametrize(
    ("table", "scene", "views", "methods"),
    [
        (1, "llff/fern", {3, 6, 9}, {"off", "progressive 0.2"}),
        (2, "colmap/kitchen", {12, 24}, {"off", "progressive 0.2"}),
        (3, "blender/lego", {8}, {"off", "progressive 0.2"}),
        (4, "llff/fern", {3}, {"off", *RATES}),
        (5, "llff/fern", {3}, {"progressive 0.2", "high gradient", "low gradient", "near", "far"}),
        (6, "llff/fern", {3}, {"progressive 0.2", *PENALTIES}),
    ],
)
def test_a_table_has_the_cells_that_the_paper_prints(data, table, scene, views, methods):
    cells = presets.sparse_cells("paper", data)
    chosen = cells_of_table(cells, table, data)
    assert {cell["scene"] for cell in chosen} == {scene}  # and no scene that the benchmark lacks
    assert {(cell["views"], cell["method"]) for cell in chosen} == {*product(views, methods)}
    assert {cell["seed"] for cell in chosen} == set(range(5))
    assert all(cell in cells for cell in chosen)
    benchmark, _ = TABLES[table - 1]
    assert all(published(benchmark, cell["views"], cell["method"]) != "-" for cell in chosen)


def test_the_tables_are_all_that_are_printed():
    printed = PUBLISHED[PUBLISHED.table != "text"]
    assert {*TABLES} == {*zip(printed.benchmark, printed.table, strict=True)}


def test_a_table_joins_the_other_choices(data, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("KGS_DATA", str(data))
    assert study(out=tmp_path / "out", preset="paper", table=4, seeds=(0,), methods=("off",), list_cells=True) == 0
    assert capsys.readouterr().out.splitlines() == ["to do: llff/fern, 3 views, dense, off, seed 0", "0 of 1 are done"]
    with pytest.raises(ValueError, match=r"^methods: .*'far'"):
        study(out=tmp_path / "out", preset="paper", table=4, methods=("far",), list_cells=True)
