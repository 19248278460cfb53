"""Runs many cells of an experiment, each once: finished ones are kept in a file and not repeated.

A cell is a dict of plain values: what to do and under which settings. Its result is appended to a JSONL file the moment
it is there, so that a run that is killed loses no finished cell, and the next one goes on. Cells run on the workers of
Dask, on this machine or on many; a worker that dies takes no other cell with it, and its own is done again.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

__all__ = ["Cell", "finished_rows", "read_rows", "run_grid"]

Cell = dict[str, Any]
Result = dict[str, Any]
PATIENCE = 10  # seconds for a scheduler to answer
_LOST = "scheduler: expected it to stay until the last cell, got a lost connection; run again to go on"


def run_grid(
    cells: Sequence[Cell],
    work: Callable[[Cell], Result],
    path: Path,
    *,
    processes: int | None = None,
    scheduler: str | None = None,
    say: Callable[[str], None] = print,
) -> list[dict[str, Any]]:
    """Do the cells that the file does not have yet.

    Args:
        cells: what to do, each different from the others.
        work: a function of a module (other processes import it); takes a cell, returns its result in plain values.
        path: JSONL, one line `{"cell": ..., "result": ...}` per finished cell; made if it is not there. A last line
            that was cut short is dropped.
        processes: how many processes of this machine, None for one per core; they share the cores, and end with this
            one. A cell whose process dies is tried once more.
        scheduler: address of a Dask scheduler, as tcp://127.0.0.1:8786; its workers take the place of local processes,
            and need the same packages and data. Workers may come and go; while there are none, the grid waits. Start
            them with `dask worker ADDRESS --nthreads 1`: one cell at a time each, on as many cores as OMP_NUM_THREADS
            says there (1 unless it is set). A cell whose worker dies goes to another one, and counts as failed when
            the scheduler's `allowed-failures` are used up (the fourth time).
        say: where lines for the user go.

    Returns:
        The lines of the given cells, in their order, without those that failed; `say` has their errors.

    Raises:
        ValueError: two cells are equal, `processes` is below 1, another run has the file, no scheduler answers, or it
            was lost; finished cells are kept.
    """
    if processes is not None and processes < 1:
        raise ValueError(f"processes: expected at least 1, got {processes}")
    keys = [_key(cell) for cell in cells]
    if len(set(keys)) < len(keys):
        raise ValueError("cells: expected each one once, got two that are equal")
    failed = 0
    with _alone(path):
        done = {_key(row["cell"]) for row in read_rows(path, repair=True)}
        missing = [cell for cell, key in zip(cells, keys, strict=True) if key not in done]
        say(f"{len(cells) - len(missing)} of {len(cells)} cells are there, {len(missing)} to do")
        if missing:
            with _workers(processes or os.cpu_count() or 1, scheduler) as client:
                for count, (cell, outcome) in enumerate(_outcomes(client, work, missing), 1):
                    if isinstance(outcome, BaseException):
                        failed += 1
                        say(f"failed: {_key(cell)}: {type(outcome).__name__}: {outcome}")
                    else:
                        _append(path, {"cell": cell, "result": outcome})
                        say(f"{count} of {len(missing)}: {_key(cell)}")
    if failed:
        say(f"{failed} of {len(missing)} cells failed; run again to try them once more")
    return finished_rows(cells, path)


def read_rows(path: Path, *, repair: bool = False) -> list[dict[str, Any]]:
    """The lines of a JSONL file, without a last one that was cut short; none where there is no file.

    Args:
        path: the file.
        repair: also take that line out of the file.

    Raises:
        ValueError: another line than the last is damaged.
    """
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
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


@contextmanager
def _workers(processes: int, scheduler: str | None) -> Iterator[Any]:
    """A client of the scheduler at this address, or of one of our own; all that waits or runs there goes with it."""
    import dask
    from distributed import Client, LocalCluster

    before = set(os.environ)  # Dask sets OMP_NUM_THREADS, PYTHONHASHSEED and others here for its workers
    try:
        if scheduler is not None:
            try:
                with ThreadPoolExecutor(1) as thread:  # the loop of a notebook has this one
                    thread.submit(asyncio.run, _identify(scheduler)).result()
                client = Client(scheduler, timeout=PATIENCE)
            except Exception as error:  # whatever Dask makes of what answers there
                raise ValueError(
                    "scheduler: expected the address of a running Dask scheduler, as tcp://127.0.0.1:8786, "
                    f"got {scheduler!r} ({error})"
                ) from None
            with client:
                yield client
            return
        threads = os.environ.get("OMP_NUM_THREADS") or str(max(1, (os.cpu_count() or 1) // processes))
        with (
            dask.config.set({"distributed.scheduler.allowed-failures": 0}),
            LocalCluster(
                processes,
                threads_per_worker=1,
                processes=True,
                memory_limit=None,  # a cell may need any share of the memory; Dask would kill its process
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
                env={"OMP_NUM_THREADS": threads},
            ) as cluster,
            Client(cluster) as client,
        ):
            yield client
    finally:
        for name in set(os.environ) - before:
            del os.environ[name]


async def _identify(address: str) -> None:
    """Asks what answers there. A Client would wait for ever for a port that is open and says nothing."""
    from distributed.core import rpc
    from distributed.security import Security

    async with rpc(address, timeout=PATIENCE, connection_args=Security().get_connection_args("client")) as server:
        kind = (await asyncio.wait_for(server.identity(), PATIENCE))["type"]
    if kind != "Scheduler":
        raise ValueError(f"this is a {kind}")


def _outcomes(
    client: Any, work: Callable[[Cell], Result], cells: Sequence[Cell]
) -> Iterator[tuple[Cell, Result | BaseException]]:
    """Every cell with its result or error, as they come; one whose worker died is tried once more.

    A cell is tied to a free worker, and waits nowhere: Dask's own queues would have it die with another cell's worker,
    and Dask would do a finished cell again whose worker is lost.
    """
    from distributed import KilledWorker, wait

    waiting, again = deque(cells), []
    running: dict[Any, tuple[Cell, str]] = {}
    while waiting or running:
        try:
            workers = client.nthreads()
            busy = Counter(address for _, address in running.values())
            for address, threads in workers.items():
                for _ in range(min(len(waiting), threads - busy[address])):
                    cell = waiting.popleft()
                    running[client.submit(work, cell, workers=[address], pure=False)] = cell, address
            wait(list(running), timeout=1, return_when="FIRST_COMPLETED") if running else time.sleep(0.1)
        except TimeoutError:
            pass
        except OSError:
            raise ValueError(_LOST) from None
        for future in [future for future in running if future.done() or running[future][1] not in workers]:
            cell, _ = running.pop(future)
            if future.status in ("cancelled", "lost"):
                raise ValueError(_LOST)
            error = future.exception() if future.done() else None
            if future.done() and not isinstance(error, KilledWorker):
                yield cell, error or future.result()
            elif cell in again:
                yield cell, RuntimeError("the worker died, and another one before it")
            else:
                again.append(cell)
                waiting.append(cell)


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
