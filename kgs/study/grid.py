"""Runs the cells of an experiment on Dask, each once: a finished cell is a line of a file, and is not done again."""

import json
import logging
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from distributed import Client, KilledWorker, LocalCluster, as_completed, get_worker

from kgs._support.errors import ArgumentError, DataError, quoted

Cell = dict[str, Any]
Work = Callable[[Cell], dict[str, Any]]
_key = json.JSONEncoder(sort_keys=True).encode  # a cell as text
PATIENCE = 10  # seconds for a scheduler to answer
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")  # torch takes the second, which Dask sets to 1, before the first
_TOPIC = "kgs-study"  # of the scheduler's events: lines of running cells


def run_grid(
    cells: Sequence[Cell],
    work: Work,
    path: Path,
    *,
    processes: int | None = None,
    scheduler: str | None = None,
    say: Callable[[str], None] = print,
    name: Callable[[Cell], str] = _key,
) -> list[dict[str, Any]]:
    """Do the cells that the file does not have yet; return the lines of those that it has then, in the cells' order.

    A run that is killed goes on where it stopped when it is started again. Dask repeats a cell whose worker dies, three
    times at most; those that died as often are tried once more in the end, each alone. A cell that fails is reported
    and does not stop the others.

    Args:
        cells: dicts of plain values, each different.
        work: a function of a module (other processes import it): takes a cell, returns its result in plain values.
        path: JSONL file that no other run writes; gets a line `{"cell": ..., "result": ...}` as soon as a cell is done.
        processes: how many processes of this machine do the cells, None for one per core; they share the cores.
        scheduler: address of a Dask scheduler, whose workers do the cells instead; they need the same packages and
            data.
        say: takes a line of text for the user.
        name: what a cell is called in these lines.

    Raises:
        ArgumentError: two cells are equal, `processes` is below 1, or the scheduler does not answer or was lost.
        DataError: a line of the file is wrong.
    """
    if processes is not None and processes < 1:
        raise ArgumentError("processes", "at least 1", processes)
    if len({_key(cell) for cell in cells}) < len(cells):
        raise ArgumentError("cells", "each one once", "two that are equal")
    path.parent.mkdir(parents=True, exist_ok=True)
    done = {_key(row["cell"]) for row in read_rows(path, repair=True)}
    missing = [cell for cell in cells if _key(cell) not in done]
    say(f"{len(cells) - len(missing)} of {len(cells)} cells are there, {len(missing)} to do")
    if missing:
        with _client(processes, scheduler) as client:
            client.subscribe_topic(_TOPIC, lambda event: say(event[1]))
            _do(client, work, missing, path, name, say)
    return finished_rows(cells, path)


def tell(line: str) -> None:
    """Show a line of a running cell where the grid was started; elsewhere than in a worker, nowhere."""
    with suppress(ValueError, RuntimeError):  # no worker; one that is closing
        get_worker().log_event(_TOPIC, line)


def _do(
    client: Client,
    work: Work,
    cells: Sequence[Cell],
    path: Path,
    name: Callable[[Cell], str],
    say: Callable[[str], None],
) -> None:
    """Do the cells on the client's workers and append each to the file when it is done."""
    cell_of: dict[Any, Cell] = {}  # of the futures that are not done
    waiting = deque(cells)
    suspects = deque[Cell]()  # their workers died, maybe of a cell beside them: each is done alone in the end
    alone = False
    finished = 0
    failed = 0
    futures = as_completed()
    begin = time.perf_counter()

    def submit() -> None:
        nonlocal alone
        if not cell_of and not waiting and suspects:
            alone = True
            waiting.append(suspects.popleft())
        if waiting and not cell_of and not _threads(client):
            say("waiting for a worker")
            client.wait_for_workers(1)
        free = _threads(client) - len(cell_of)  # a queued cell would be lost with its worker
        for _ in range(min(free, len(waiting))):
            cell = waiting.popleft()
            future = client.submit(work, cell, pure=False)
            cell_of[future] = cell
            futures.add(future)

    submit()
    for future in futures:
        cell = cell_of.pop(future)
        if future.status in ("cancelled", "lost"):
            raise _lost()
        error = future.exception()
        if isinstance(error, KilledWorker) and not alone:
            suspects.append(cell)
        elif error:
            failed += 1
            say(f"failed: {name(cell)}: {type(error).__name__}: {error}")
        else:
            finished += 1
            with path.open("ab") as file:
                file.write(_key({"cell": cell, "result": future.result()}).encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())
            say(f"{finished + failed} of {len(cells)}: {name(cell)}")
        future.release()  # else Dask does the cell again if this worker dies later
        submit()
    seconds = time.perf_counter() - begin
    say(f"{finished} cells in {seconds:.0f} s, {60 * finished / seconds:.2f} a minute")
    if failed:
        say(f"{failed} of {len(cells)} cells failed; run again to try them once more")


def _threads(client: Client) -> int:
    """Of all workers together: so many cells run at a time."""
    try:
        return sum(client.nthreads().values())
    except OSError:
        raise _lost() from None


def _lost() -> ArgumentError:
    expected = "one that stays until the last cell"
    return ArgumentError("scheduler", expected, "a lost connection", advice="run again to go on")


@contextmanager
def _client(processes: int | None, scheduler: str | None) -> Iterator[Client]:
    """A client of the scheduler at this address, or of processes of this machine."""
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=PATIENCE)
        except (OSError, ValueError):  # nothing answers; no address
            expected = "the address of a running Dask scheduler, as tcp://127.0.0.1:8786"
            raise ArgumentError("scheduler", expected, repr(scheduler)) from None
        with client:
            yield client
        return
    cores = os.cpu_count() or 1
    count = processes or cores
    threads = os.environ.get("OMP_NUM_THREADS") or str(max(1, cores // count))
    before = set(os.environ)  # Dask sets OMP_NUM_THREADS, PYTHONHASHSEED and others here for its workers
    try:
        cluster = LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            memory_limit=None,  # a cell may need any share of the memory; Dask would kill its process
            env=dict.fromkeys(_THREADS, threads),
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
        )
        with cluster, Client(cluster) as client:
            yield client
    finally:
        for name in set(os.environ) - before:
            del os.environ[name]


def read_rows(path: Path, *, repair: bool = False) -> list[dict[str, Any]]:
    """The lines of a JSONL file, none if there is no file. A last line that was cut short is left out.

    Args:
        path: the file.
        repair: also remove such a line from the file.

    Raises:
        DataError: another line is not JSON, or a line is not that of a cell.
    """
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
        except ValueError as error:
            if number < len(lines):
                raise DataError(path, f"line {number}", "JSON", advice=str(error)) from error
            break
        if not isinstance(row, dict) or not isinstance(row.get("cell"), dict):
            raise DataError(path, f"line {number}", "a cell and its result", quoted(line))
        rows.append(row)
    if repair and lines:
        with path.open("r+b") as file:
            whole = b"".join(lines[: len(rows)])
            file.seek(len(whole))
            file.write(b"\n" if rows and not whole.endswith(b"\n") else b"")
            file.truncate()
    return rows


def finished_rows(cells: Sequence[Cell], path: Path) -> list[dict[str, Any]]:
    """The lines of the cells that the file has, in the cells' order; where a cell has two lines, the last."""
    done = {_key(row["cell"]): row for row in read_rows(path)}
    return [done[key] for key in map(_key, cells) if key in done]
