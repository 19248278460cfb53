"""The grid of cells: each is done once, whatever happens in between."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import pytest
from grid_cells import cells_in, do, processes_left, threads_of_torch, times_done

from kgs.study import grid
from kgs.study.grid import read_rows, run_grid

CELLS = [{"x": x, "name": "a"} for x in range(6)]


def square(cell):
    return {"y": cell["x"] ** 2}


def quiet(_):
    pass


@pytest.fixture(scope="module")
def cluster():
    """A Dask cluster of two worker processes."""
    distributed = pytest.importorskip("distributed")
    with (
        mock.patch.dict(os.environ),  # Dask sets OMP_NUM_THREADS, PYTHONHASHSEED and others here for its workers
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
        ) as cluster,
    ):
        yield cluster


@pytest.fixture(params=["local", "one", "dask"])
def where(request):
    """Where the cells run: arguments of run_grid."""
    if request.param != "dask":
        return {"processes": 1 if request.param == "one" else 2}
    return {"scheduler": request.getfixturevalue("cluster").scheduler_address}


def test_finished_cells_are_not_repeated(tmp_path, threads):
    path, cells = tmp_path / "results" / "g.jsonl", cells_in(tmp_path, 6, seconds=0)
    run_grid(cells[:4], do, path, scheduler=threads, say=quiet)
    rows = run_grid([dict(reversed(cell.items())) for cell in cells], do, path, scheduler=threads, say=quiet)
    assert times_done(tmp_path) == dict.fromkeys(range(6), 1)
    assert [row["cell"]["x"] for row in rows] == list(range(6))


@pytest.mark.parametrize("newline", [b"\n", b"\r\n"], ids=["unix", "windows"])
@pytest.mark.parametrize(("cut", "kept"), [(0, 6), (1, 6), (9, 5)], ids=["whole", "without its end", "cut short"])
def test_a_last_line_is_done_again_only_if_it_is_not_whole(tmp_path, threads, newline, cut, kept):
    path = tmp_path / "g.jsonl"
    content = newline.join(json.dumps({"cell": cell, "result": {"y": 7}}).encode() for cell in CELLS) + newline
    path.write_bytes(content[: len(content) - cut])
    assert len(read_rows(path)) == kept
    rows = run_grid(CELLS, square, path, scheduler=threads, say=quiet)
    assert [row["result"]["y"] for row in rows] == [7] * kept + [25] * (6 - kept)
    assert len(path.read_bytes().splitlines()) == 6
    assert path.read_bytes().startswith(content[: content.rindex(b'{"cell')])
    assert len(read_rows(path)) == 6


def test_a_failing_cell_stops_no_other(tmp_path, threads):
    path, cells = tmp_path / "g.jsonl", cells_in(tmp_path, 6, kill={3: "fail"}, seconds=0)
    said = []
    rows = run_grid(cells, do, path, scheduler=threads, say=said.append)
    assert [row["cell"]["x"] for row in rows] == [0, 1, 2, 4, 5]
    assert sorted(row["cell"]["x"] for row in read_rows(path)) == [0, 1, 2, 4, 5]
    (failed,) = (line for line in said if line.startswith("failed: "))
    assert '"x": 3' in failed
    assert failed.endswith("ArithmeticError: three")
    assert said[-1].startswith("1 of 6 cells failed")
    assert len(run_grid(cells, square, path, scheduler=threads, say=quiet)) == 6


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_so_many_processes_share_the_cores(tmp_path, monkeypatch, processes):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    cells = [{"x": x} for x in range(2 * processes)]
    rows = run_grid(cells, threads_of_torch, tmp_path / "g.jsonl", processes=processes, say=quiet)
    assert len({row["result"]["process"] for row in rows}) == processes
    assert {row["result"]["threads"] for row in rows} == {2 // processes}


@pytest.mark.slow
def test_a_process_that_dies_takes_no_other_cell_with_it(tmp_path, where):
    """Its cell is done again, and no other twice; a cell that always kills fails alone."""
    killer = 3
    path, cells = tmp_path / "g.jsonl", cells_in(tmp_path, 7, kill={2: "once", killer: "always"})
    said = []
    run_grid(cells, do, path, say=said.append, **where)
    (failed,) = (line for line in said if line.startswith("failed: "))
    assert f'"x": {killer}}}: KilledWorker: ' in failed
    others = set(range(7)) - {killer}
    assert sorted((row["cell"]["x"], row["result"]["y"]) for row in read_rows(path)) == [
        (x, x**2) for x in sorted(others)
    ]
    assert times_done(tmp_path) == dict.fromkeys(others, 1)
    assert (tmp_path / "killed 2").exists()
    assert "scheduler" in where or not processes_left(tmp_path)


@pytest.mark.slow
def test_an_interrupt_leaves_nothing_at_the_scheduler(tmp_path, cluster):
    def interrupt(line):
        if line.startswith("2 of 6"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_grid(cells_in(tmp_path, 6), do, tmp_path / "g.jsonl", scheduler=cluster.scheduler_address, say=interrupt)
    assert len(read_rows(tmp_path / "g.jsonl")) == 2
    until = time.monotonic() + 10
    while (left := len(cluster.scheduler.tasks) + len(cluster.scheduler.clients)) > 1 and time.monotonic() < until:
        time.sleep(0.05)
    assert left == 1  # a client that every scheduler has


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_killed_grid_leaves_no_process_and_goes_on(tmp_path, monkeypatch, threads, number):
    path, cells = tmp_path / "g.jsonl", cells_in(tmp_path, 5, seconds=0.5)
    script = f"""
from pathlib import Path
from grid_cells import do
from kgs.study.grid import run_grid
run_grid({cells!r}, do, Path({str(path)!r}), processes=2)
"""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        while len(read_rows(path)) < 2:
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(number)
        assert process.stderr.read().count(b"Traceback") == (number == signal.SIGINT)
    assert process.returncode == -number
    assert not processes_left(tmp_path)
    kept = {row["cell"]["x"] for row in read_rows(path)}
    assert len(kept) < 5
    run_grid(cells, do, path, scheduler=threads, say=quiet)
    assert times_done(tmp_path).keys() == set(range(5))
    assert {times_done(tmp_path)[x] for x in kept} == {1}


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "127.0.0.1", "nonsense"])
def test_an_address_where_no_scheduler_answers(tmp_path, monkeypatch, address):
    monkeypatch.setattr(grid, "PATIENCE", 0.5)
    with pytest.raises(ValueError, match=f"^scheduler: expected .* Dask scheduler.*, got '{address}'"):
        run_grid(CELLS, square, tmp_path / "g.jsonl", scheduler=address, say=quiet)
