"""The grid of cells: each is done once, whatever happens in between."""

import json
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from kgs.bench.grid import read_rows, run_grid

CELLS = [{"x": x, "name": "a"} for x in range(6)]


def square(cell):
    return {"y": cell["x"] ** 2}


def fails_on_three(cell):
    if cell["x"] == 3:
        raise ArithmeticError("three")
    return square(cell)


def quiet(_):
    pass


@pytest.fixture
def threads():
    with ThreadPoolExecutor(2) as executor:
        yield executor


def test_rows_come_in_the_order_of_the_cells(tmp_path, threads):
    def slow_first(cell):
        time.sleep(0.05 if cell["x"] == 0 else 0.0)
        return square(cell)

    rows = run_grid(CELLS, slow_first, tmp_path / "g.jsonl", executor=threads, say=quiet)
    assert [row["result"]["y"] for row in rows] == [x**2 for x in range(6)]
    assert len(read_rows(tmp_path / "g.jsonl")) == 6


def test_finished_cells_are_not_repeated(tmp_path, threads):
    path, calls = tmp_path / "results" / "g.jsonl", []

    def noted(cell):
        calls.append(cell["x"])
        return square(cell)

    run_grid(CELLS[:4], noted, path, executor=threads, say=quiet)
    rows = run_grid([dict(reversed(cell.items())) for cell in CELLS], noted, path, executor=threads, say=quiet)
    assert sorted(calls) == list(range(6))
    assert [row["cell"]["x"] for row in rows] == list(range(6))


def test_a_line_cut_short_is_done_again(tmp_path, threads):
    path = tmp_path / "g.jsonl"
    run_grid(CELLS, square, path, executor=threads, say=quiet)
    content = path.read_text()
    path.write_text(content[:-9])
    assert len(read_rows(path)) == 5
    rows = run_grid(CELLS, square, path, executor=threads, say=quiet)
    assert [row["result"]["y"] for row in rows] == [x**2 for x in range(6)]
    assert sorted(path.read_text().splitlines()) == sorted(content.splitlines())


def test_a_whole_last_line_without_its_end_is_kept(tmp_path, threads):
    path = tmp_path / "g.jsonl"
    path.write_text(json.dumps({"cell": CELLS[0], "result": {"y": 7}}))
    rows = run_grid(CELLS[:2], square, path, executor=threads, say=quiet)
    assert [row["result"]["y"] for row in rows] == [7, 1]
    assert len(path.read_text().splitlines()) == 2


def test_a_damaged_line_before_the_last_is_an_error(tmp_path):
    path = tmp_path / "g.jsonl"
    path.write_text('{"cell": \n{"cell": {}, "result": {}}\n')
    with pytest.raises(ValueError, match="line 1"):
        read_rows(path)


def test_a_failing_cell_stops_no_other(tmp_path, threads):
    path = tmp_path / "g.jsonl"
    with pytest.raises(RuntimeError, match=r"1 of 6 cells failed.*three"):
        run_grid(CELLS, fails_on_three, path, executor=threads, say=quiet)
    assert sorted(row["cell"]["x"] for row in read_rows(path)) == [0, 1, 2, 4, 5]
    assert len(run_grid(CELLS, square, path, executor=threads, say=quiet)) == 6


def test_local_processes(tmp_path):
    rows = run_grid(CELLS[:3], square, tmp_path / "g.jsonl", processes=2, say=quiet)
    assert [row["result"]["y"] for row in rows] == [0, 1, 4]


def test_wrong_arguments(tmp_path):
    with pytest.raises(ValueError, match="cells"):
        run_grid([{"x": 1}, {"x": 1}], square, tmp_path / "g.jsonl")
    with pytest.raises(ValueError, match="processes"):
        run_grid(CELLS, square, tmp_path / "g.jsonl", processes=0)
