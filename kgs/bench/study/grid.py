"""Runs many cells of an experiment on the workers of Dask, each once: finished ones are kept in a file."""

import asyncio
import json
import logging
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from distributed import Client, KilledWorker, LocalCluster, Security, wait
from distributed.core import rpc

from kgs.io.results_folder import held

Cell = dict[str, Any]
Work = Callable[[Cell], dict[str, Any]]
_key = json.JSONEncoder(sort_keys=True).encode  # a cell as text
PATIENCE = 10  # seconds for a scheduler to answer
_LOST = "scheduler: expected it to stay until the last cell, got a lost connection; run again to go on"


def run_grid(
    cells: Sequence[Cell],
    work: Work,
    path: Path,
    *,
    processes: int | None = None,
    scheduler: str | None = None,
    say: Callable[[str], None] = print,
) -> list[dict[str, Any]]:
    """Do the cells that the file does not have yet; return the lines of those that are there, in the cells' order.

    Args:
        cells: dicts of plain values, each different. One whose worker dies is tried once more.
        work: a function of a module (other processes import it); takes a cell, returns its result in plain values.
        path: JSONL, a line `{"cell": ..., "result": ...}` as soon as a cell is done; one that was cut short is dropped.
        processes: how many processes of this machine, None for one per core; they share the cores.
        scheduler: address of a Dask scheduler whose workers, with the same packages and data, take their place.
        say: where lines for the user go, errors of cells among them.

    Raises:
        ValueError: equal cells, `processes` below 1, a file that another run has, no scheduler, or one that was lost.
    """
    if processes is not None and processes < 1:
        raise ValueError(f"processes: expected at least 1, got {processes}")
    if len({_key(cell) for cell in cells}) < len(cells):
        raise ValueError("cells: expected each one once, got two that are equal")
    failed = 0
    with _alone(path):
        done = {_key(row["cell"]) for row in read_rows(path, repair=True)}
        missing = [cell for cell in cells if _key(cell) not in done]
        say(f"{len(cells) - len(missing)} of {len(cells)} cells are there, {len(missing)} to do")
        with _workers(processes, scheduler) if missing else nullcontext() as client:
            for count, (cell, outcome) in enumerate(_outcomes(client, work, missing), 1):
                if isinstance(outcome, BaseException):
                    failed += 1
                    say(f"failed: {_key(cell)}: {type(outcome).__name__}: {outcome}")
                    continue
                with path.open("a", encoding="utf-8") as file:
                    file.write(_key({"cell": cell, "result": outcome}) + "\n")
                    file.flush()
                    os.fsync(file.fileno())
                say(f"{count} of {len(missing)}: {_key(cell)}")
    if failed:
        say(f"{failed} of {len(missing)} cells failed; run again to try them once more")
    return finished_rows(cells, path)


def read_rows(path: Path, *, repair: bool = False) -> list[dict[str, Any]]:
    """The lines of a JSONL file, none without one; not a last one that is cut short, which `repair` takes out."""
    lines = path.read_bytes().splitlines() if path.exists() else []
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            rows.append(json.loads(line))
        except ValueError as error:
            if number < len(lines):
                raise ValueError(f"{path}: line {number} is no JSON ({error})") from error
    if repair and lines:
        with path.open("r+b") as file:
            file.seek(max(0, sum(len(line) + 1 for line in lines[: len(rows)]) - 1))
            file.write(b"\n" if rows else b"")
            file.truncate()
    return rows


def finished_rows(cells: Sequence[Cell], path: Path) -> list[dict[str, Any]]:
    """The lines of those of the cells that the file has, in the cells' order; of two lines of one cell the last."""
    done = {_key(row["cell"]): row for row in read_rows(path)}
    return [done[key] for key in map(_key, cells) if key in done]


@contextmanager
def _workers(processes: int | None, scheduler: str | None) -> Iterator[Any]:
    """A client of the scheduler at this address, or of one of our own; all that waits or runs there goes with it."""
    cores = os.cpu_count() or 1
    local: dict[str, Any] = {"n_workers": processes or cores, "threads_per_worker": 1, "processes": True}
    local |= {"memory_limit": None}  # a cell may need any share of the memory; Dask would kill its process
    local |= {"env": {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS") or str(cores // (processes or cores) or 1)}}
    local |= {"dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}
    before = set(os.environ)  # Dask sets OMP_NUM_THREADS, PYTHONHASHSEED and others here for its workers
    try:
        if scheduler is not None:
            with ThreadPoolExecutor(1) as thread:  # the loop of a notebook has this one
                found = thread.submit(asyncio.run, _identify(scheduler))
            if (kind := found.exception() or found.result()) != "Scheduler":
                expected = "expected the address of a running Dask scheduler, as tcp://127.0.0.1:8786"
                raise ValueError(f"scheduler: {expected}, got {scheduler!r} ({kind!r})")
        with nullcontext(scheduler) if scheduler else LocalCluster(**local) as place, Client(place) as client:
            yield client
    finally:
        for name in set(os.environ) - before:
            del os.environ[name]


async def _identify(address: str) -> str:
    """What answers there. A Client would wait for ever for a port that is open and says nothing."""
    async with rpc(address, timeout=PATIENCE, connection_args=Security().get_connection_args("client")) as server:
        return str((await asyncio.wait_for(server.identity(), PATIENCE))["type"])


def _outcomes(client: Any, work: Work, cells: Sequence[Cell]) -> Iterator[tuple[Cell, Any]]:
    """Every cell with its result or error, as they come; one whose worker died is tried once more."""
    # Each is tied to a free worker: Dask's queues would let it die with another's, and repeat what a lost one finished.
    waiting, running, again = deque(cells), dict[Any, tuple[Cell, str]](), list[Cell]()
    while waiting or running:
        try:
            workers = client.nthreads()
            busy = Counter(address for _, address in running.values())
            for address, threads in workers.items():
                for cell in [waiting.popleft() for _ in range(min(len(waiting), threads - busy[address]))]:
                    running[client.submit(work, cell, workers=[address], pure=False)] = cell, address
            with suppress(TimeoutError):
                wait(list(running), timeout=1, return_when="FIRST_COMPLETED") if running else time.sleep(0.1)
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


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Holds the file, made if it is not there, against other runs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with held(path) as ours:
        if not ours:
            raise ValueError(f"{path}: expected no other run to write this file, but one does")
        yield
