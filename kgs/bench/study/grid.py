"""Runs the cells of an experiment on Dask, each once: a finished cell is a line of a file, and is not done again."""

import json
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from distributed import Client, LocalCluster, as_completed

from kgs.io.results_folder import held

Cell = dict[str, Any]
Work = Callable[[Cell], dict[str, Any]]
_key = json.JSONEncoder(sort_keys=True).encode  # a cell as text
_TIMEOUT = 10  # seconds for a scheduler to answer


def run_grid(
    cells: Sequence[Cell],
    work: Work,
    path: Path,
    *,
    processes: int | None = None,
    scheduler: str | None = None,
    say: Callable[[str], None] = print,
) -> list[dict[str, Any]]:
    """Do the cells that the file does not have yet; return the lines of those that it has then, in the cells' order.

    A run that is killed goes on where it stopped when it is started again. Dask repeats a cell whose worker dies, three
    times at most; a cell that fails is reported and does not stop the others.

    Args:
        cells: dicts of plain values, each different.
        work: a function of a module (other processes import it): takes a cell, returns its result in plain values.
        path: JSONL file; gets a line `{"cell": ..., "result": ...}` as soon as a cell is done.
        processes: how many processes of this machine do the cells, None for one per core; they share the cores.
        scheduler: address of a Dask scheduler, whose workers do the cells instead; they need the same packages and
            data.
        say: takes a line of text for the user.

    Raises:
        ValueError: two cells are equal, `processes` is below 1, another run writes the file, or the scheduler does not
            answer or was lost.
    """
    if processes is not None and processes < 1:
        raise ValueError(f"processes: expected at least 1, got {processes}")
    if len({_key(cell) for cell in cells}) < len(cells):
        raise ValueError("cells: expected each one once, got two that are equal")
    with _alone(path):
        done = {_key(row["cell"]) for row in read_rows(path, repair=True)}
        missing = [cell for cell in cells if _key(cell) not in done]
        say(f"{len(cells) - len(missing)} of {len(cells)} cells are there, {len(missing)} to do")
        if missing:
            with _client(processes, scheduler) as client:
                _do(client, work, missing, path, say)
    return finished_rows(cells, path)


def _do(client: Client, work: Work, cells: Sequence[Cell], path: Path, say: Callable[[str], None]) -> None:
    """Do the cells on the client's workers and append each to the file when it is done."""
    cell_of: dict[Any, Cell] = {}  # of the futures that are not done
    waiting, failed = iter(cells), 0
    futures = as_completed()

    def submit_to_free_workers() -> None:
        free = sum(client.nthreads().values()) - len(cell_of)  # a queued cell would be lost with its worker
        for cell in islice(waiting, max(0, free)):
            future = client.submit(work, cell, pure=False)
            cell_of[future] = cell
            futures.add(future)

    client.wait_for_workers(1)
    submit_to_free_workers()
    for count, future in enumerate(futures, 1):
        cell = cell_of.pop(future)
        if future.cancelled():
            raise ValueError("scheduler: lost the connection to it; run again to go on")
        if error := future.exception():
            failed += 1
            say(f"failed: {_key(cell)}: {type(error).__name__}: {error}")
        else:
            _append(path, {"cell": cell, "result": future.result()})
            say(f"{count} of {len(cells)}: {_key(cell)}")
        submit_to_free_workers()
    if failed:
        say(f"{failed} of {len(cells)} cells failed; run again to try them once more")


def _append(path: Path, row: dict[str, Any]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(_key(row) + "\n")
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def _client(processes: int | None, scheduler: str | None) -> Iterator[Client]:
    """A client of the scheduler at this address, or of processes of this machine."""
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=_TIMEOUT)
        except (OSError, ValueError, TypeError) as error:  # what Dask raises for no answer, no port, and a worker
            expected = "expected the address of a running Dask scheduler, as tcp://127.0.0.1:8786"
            raise ValueError(f"scheduler: {expected}, got {scheduler!r} ({error})") from error
        with client:
            yield client
        return
    cores = os.cpu_count() or 1
    count = processes or cores
    threads = os.environ.get("OMP_NUM_THREADS") or str(max(1, cores // count))
    cluster = LocalCluster(
        count,
        threads_per_worker=1,
        processes=True,
        memory_limit=None,  # a cell may need any share of the memory; Dask would kill its process
        env={"OMP_NUM_THREADS": threads},
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    )
    with cluster, Client(cluster) as client:
        yield client


def read_rows(path: Path, *, repair: bool = False) -> list[dict[str, Any]]:
    """The lines of a JSONL file, none if there is no file. A last line that was cut short is left out.

    Args:
        path: the file.
        repair: also remove a last line that was cut short from the file.

    Raises:
        ValueError: another line is not JSON.
    """
    lines = path.read_bytes().splitlines() if path.exists() else []
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            rows.append(json.loads(line))
        except ValueError as error:
            if number < len(lines):
                raise ValueError(f"{path}: line {number} is not JSON ({error})") from error
    if repair and lines:
        with path.open("r+b") as file:
            file.seek(max(0, sum(len(line) + 1 for line in lines[: len(rows)]) - 1))
            file.write(b"\n" if rows else b"")
            file.truncate()
    return rows


def finished_rows(cells: Sequence[Cell], path: Path) -> list[dict[str, Any]]:
    """The lines of the cells that the file has, in the cells' order; where a cell has two lines, the last."""
    done = {_key(row["cell"]): row for row in read_rows(path)}
    return [done[key] for key in map(_key, cells) if key in done]


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Keep other runs from writing the file, which is created if it is not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with held(path) as ours:
        if not ours:
            raise ValueError(f"{path}: expected no other run to write this file, but one does")
        yield
