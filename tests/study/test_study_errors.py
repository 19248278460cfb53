"""What is refused by the modules of the study: the type of the error, and the name that it begins with."""

import json

import pytest
import torch
from refusals import refused
from study_rows import made_up, tiny_cell

from kgs import ArgumentError, DataError
from kgs.datasets.synthetic import views_beyond
from kgs.study.cells import sparse_cell
from kgs.study.command import study
from kgs.study.grid import read_rows, run_grid
from kgs.study.overfitting import coadaptation
from kgs.study.pairs import cells_frame
from kgs.study.presets import select, sparse_cells, with_steps
from kgs.study.published import cells_of_table
from kgs.study.report import write_report
from kgs.study.rivals import SelectiveDrop, opacity_l1

ROW = made_up("llff/fern", 3, "dense", "off", 0)
LONGER = {"cell": ROW["cell"] | {"fit": {"steps": 10_000}}, "result": ROW["result"]}


def damaged_lines(folder):
    path = folder / "g.jsonl"
    path.write_text('{"cell": \n{"cell": {}, "result": {}}\n')
    read_rows(path)


def lines_of_others(folder):
    path = folder / "g.jsonl"
    path.write_text('{"cell": {}, "result": {}}\n{"step": 1}\n')
    read_rows(path)


def scores_of_shape(*shape):
    drop = SelectiveDrop(0.2, "constant")
    drop.scores = torch.zeros(shape)
    drop(torch.ones(5))


CASES = [
    ("preset", ArgumentError, lambda folder: sparse_cells("fast", folder)),
    ("scenes", ArgumentError, lambda folder: select(sparse_cells("quick", folder), scenes=["fern"])),
    ("views", ArgumentError, lambda folder: select(sparse_cells("quick", folder), views=[4])),
    ("cells", ArgumentError, lambda folder: select(sparse_cells("quick", folder), methods=["far"], seeds=[1])),
    ("KGS_DATA", DataError, lambda _: sparse_cells("cpu", None)),
    ("FOLDER: llff/fern", DataError, lambda folder: sparse_cells("cpu", folder)),
    ("FOLDER", DataError, lambda folder: sparse_cells("paper", folder)),
    ("FOLDER: llff/fern", DataError, lambda folder: sparse_cells("guard", folder)),
    ("llff/fern", DataError, lambda _: sparse_cell(tiny_cell() | {"scene": "llff/fern"})),
    *[
        ("out, count", ArgumentError, lambda _, out=out, count=count: views_beyond(out, count, (6, 8)))
        for out, count in ((0.0, 6), (float("nan"), 6), (1.0, 0))
    ],
    *[("steps", ArgumentError, lambda _, steps=steps: with_steps([tiny_cell()], steps)) for steps in (0, -1)],
    ("steps", ArgumentError, lambda folder: study(out=folder, steps=0)),
    *[
        ("table", ArgumentError, lambda folder, table=table: cells_of_table([tiny_cell()], table, folder))
        for table in (0, 7)
    ],
    ("FOLDER/colmap", DataError, lambda folder: cells_of_table([tiny_cell()], 2, folder)),  # has no scene of the table
    ("table", ArgumentError, lambda folder: study(out=folder, table=1)),
    ("opacities", ArgumentError, lambda _: opacity_l1(torch.rand(3, 1), torch.rand(3, 1))),
    ("scores", ArgumentError, lambda _: opacity_l1(torch.rand(3), torch.rand(4))),
    ("cells", ArgumentError, lambda folder: run_grid([{"x": 1}, {"x": 1}], json.dumps, folder / "g.jsonl")),
    ("processes", ArgumentError, lambda folder: run_grid([{"x": 1}], json.dumps, folder / "g.jsonl", processes=0)),
    ("FOLDER/g.jsonl: line 1", DataError, damaged_lines),
    ("FOLDER/g.jsonl: line 2", DataError, lines_of_others),
    ("subsets", ArgumentError, lambda _: coadaptation(None, None, subsets=1)),
    ("rows", ArgumentError, lambda _: cells_frame([])),
    ("rows", ArgumentError, lambda _: cells_frame([ROW, ROW])),
    ("rows", ArgumentError, lambda folder: write_report([], folder, "command", 0)),
    ("rows", ArgumentError, lambda folder: write_report([ROW, LONGER], folder, "command", 2)),
    *[
        ("scores", ArgumentError, lambda _, shape=shape: scores_of_shape(*shape))
        for shape in ((4,), (5, 1), (2, 5), (0,))
    ],
]


@pytest.mark.parametrize(("name", "kind", "call"), CASES)
def test_what_is_wrong_is_named(name, kind, call, tmp_path):
    where, _, key = name.replace("FOLDER", str(tmp_path)).partition(": ")
    with refused(kind, **({"name": name} if kind is ArgumentError else {"key": key})) as error:
        call(tmp_path)
    assert str(error.value).startswith(where)
