"""Runs many cells of an experiment, each once: finished ones are kept in a file and not repeated.

A cell is a dict of plain values: what to do and under which settings. Its result is appended to a JSONL file the moment
it is there, so that a run that is killed loses no finished cell, and the next one goes on. Cells run in local
processes, or on the workers of a Dask scheduler; a process that dies takes no other cell with it, and its own is done
again.
"""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from .workers import LOST, Cell, Result, dask_workers, local_processes

__all__ = ["finished_rows", "read_rows", "run_grid"]


def run_grid(
    cells: Sequence[Cell],
    work: Callable[[Cell], Result],
    path: Path,
    *,
    processes: int = 1,
    scheduler: str | None = None,
    say: Callable[[str], None] = print,
) -> list[dict[str, Any]]:
    """Do the cells that the file does not have yet.

    Args:
        cells: what to do, each different from the others.
        work: a function of a module (other processes import it); takes a cell, returns its result in plain values.
        path: JSONL, one line `{"cell": ..., "result": ...}` a finished cell; made if it is not there. A last line that
            was cut short is dropped.
        processes: how many local processes; they share the cores, and end with this one. A cell whose process dies is
            tried once more.
        scheduler: address of a Dask scheduler, as tcp://127.0.0.1:8786; its workers take the place of local processes,
            and need the same packages and data. Workers may come and go; while there are none, the grid waits. Start
            them with `dask worker ADDRESS --nthreads 1`: one cell at a time each, on as many cores as OMP_NUM_THREADS
            says there (1 unless it is set). A cell whose worker dies goes to another one, and counts as failed when
            the scheduler's `allowed-failures` are used up (the fourth time).
        say: where lines for the user go.

    Returns:
        The lines of the given cells, in their order.

    Raises:
        ValueError: two cells are equal, `processes` is below 1, another run has the file, or no scheduler answers
            within ten seconds.
        RuntimeError: cells failed; the message has the first error. All others are done and kept.
        ConnectionError: the scheduler was lost; finished cells are kept.
    """
    if processes < 1:
        raise ValueError(f"processes: expected at least 1, got {processes}")
    keys = [_key(cell) for cell in cells]
    if len(set(keys)) < len(keys):
        raise ValueError("cells: expected each one once, got two that are equal")
    failures: list[str] = []
    with _alone(path):
        done = {_key(row["cell"]) for row in read_rows(path, repair=True)}
        missing = [cell for cell, key in zip(cells, keys, strict=True) if key not in done]
        say(f"{len(cells) - len(missing)} of {len(cells)} cells are there, {len(missing)} to do")
        if missing:
            places = local_processes(work, processes) if scheduler is None else dask_workers(work, scheduler, say)
            with places as (start, limit):
                failures = _keep(_outcomes(missing, start, limit), len(missing), path, say)
    if failures:
        raise RuntimeError(f"{len(failures)} of {len(missing)} cells failed, the first one: {failures[0]}")
    return finished_rows(cells, path)


def read_rows(path: Path, *, repair: bool = False) -> list[dict[str, Any]]:
    """The lines of a JSONL file, without a last one that was cut short; none where there is no file.

    Args:
        path: the file.
        repair: also take that line out of the file.

    Raises:
        ValueError: another line than the last is damaged.
    """
    if not path.exists():
        return []
    lines = path.read_bytes().splitlines(keepends=True)
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            rows.append(json.loads(line))
        except ValueError as error:
            if number < len(lines):
                raise ValueError(f"{path}: line {number} is no JSON ({error})") from error
    whole = lines[: len(rows)]
    if repair and len(whole) < len(lines):
        os.truncate(path, sum(map(len, whole)))
    elif repair and whole and not whole[-1].endswith(b"\n"):
        with path.open("ab") as file:
            file.write(b"\n")
    return rows


def finished_rows(cells: Sequence[Cell], path: Path) -> list[dict[str, Any]]:
    """The lines of those of the cells that the file has, in the cells' order; of two lines of one cell the last."""
    done = {_key(row["cell"]): row for row in read_rows(path)}
    return [done[key] for key in map(_key, cells) if key in done]


def _outcomes(
    cells: Sequence[Cell], start: Callable[[Cell], Future[Result]], limit: Callable[[], int]
) -> Iterator[tuple[Cell, Result | BaseException]]:
    """Every cell with its result or error, as they come.

    No more cells are given out than can run: Dask counts the death of a worker against all cells that wait there.
    """
    waiting = deque(cells)
    running: dict[Future[Result], Cell] = {}
    while waiting or running:
        room = max(1, limit()) - len(running)
        for _ in range(min(room, len(waiting))):
            cell = waiting.popleft()
            running[start(cell)] = cell
        ended = _collect(running)
        for cell, outcome in ended:
            if not isinstance(outcome, CancelledError):
                yield cell, outcome
        if any(isinstance(outcome, CancelledError) for _, outcome in ended):
            raise ConnectionError(LOST)


def _keep(
    outcomes: Iterator[tuple[Cell, Result | BaseException]], total: int, path: Path, say: Callable[[str], None]
) -> list[str]:
    """Appends the results to the file as they come; returns what failed."""
    failures: list[str] = []
    for count, (cell, outcome) in enumerate(outcomes, 1):
        if isinstance(outcome, BaseException):
            failures.append(f"{_key(cell)}: {type(outcome).__name__}: {outcome}")
            say(f"failed: {failures[-1]}")
            continue
        _append(path, {"cell": cell, "result": outcome})
        say(f"{count} of {total}: {_key(cell)}")
    return failures


def _collect(running: dict[Future[Result], Cell]) -> list[tuple[Cell, Result | BaseException]]:
    """Takes out those that ended within a second.

    Nothing may refer to their futures after that: Dask does a finished cell again when its worker is lost, for as long
    as somebody has its future.
    """
    ended = wait(running, timeout=1, return_when=FIRST_COMPLETED).done
    return [(running.pop(f), CancelledError() if f.cancelled() else f.exception() or f.result()) for f in ended]


def _key(cell: Cell) -> str:
    return json.dumps(cell, sort_keys=True)


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Holds the file, made if it is not there, against other runs; they would repeat cells and cut lines."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as file:
        try:
            fcntl = import_module("fcntl")
        except ImportError:  # Windows
            yield
            return
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(f"{path}: expected no other run to write this file, but one does") from error
        yield


def _append(path: Path, row: dict[str, Any]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row, sort_keys=True) + "\n")
        file.flush()
        os.fsync(file.fileno())
