"""Runs many cells of an experiment, each once: finished ones are kept in a file and not repeated.

A cell is a dict of plain values: what to do and under which settings. Its result is appended to a JSONL file the moment
it is there, so that a run that is killed loses no finished cell, and the next one goes on. Where the cells run is a
matter of the executor: local processes, or any other that has the interface of `concurrent.futures`.
"""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

__all__ = ["read_rows", "run_grid"]

Cell = dict[str, Any]


def run_grid(
    cells: Sequence[Cell],
    work: Callable[[Cell], dict[str, Any]],
    path: Path,
    *,
    executor: Executor | None = None,
    processes: int = 1,
    say: Callable[[str], None] = print,
) -> list[dict[str, Any]]:
    """Do the cells that the file does not have yet.

    Args:
        cells: what to do, each different from the others.
        work: a function of a module (other processes import it); takes a cell, returns its result in plain values.
        path: JSONL, one line `{"cell": ..., "result": ...}` a finished cell; made if it is not there. A last line that
            was cut short is dropped.
        executor: where to run them; None makes local processes, and ends them.
        processes: how many local processes; they share the cores.
        say: where lines for the user go.

    Returns:
        The lines of the given cells, in their order.

    Raises:
        ValueError: two cells are equal, or `processes` is below 1.
        RuntimeError: cells failed; the message has the first error. All others are done and kept.
    """
    if processes < 1:
        raise ValueError(f"processes: expected at least 1, got {processes}")
    keys = [_key(cell) for cell in cells]
    if len(set(keys)) < len(keys):
        raise ValueError("cells: expected each one once, got two that are equal")
    done = {_key(row["cell"]): row for row in read_rows(path, repair=True)}
    missing = [cell for cell, key in zip(cells, keys, strict=True) if key not in done]
    say(f"{len(cells) - len(missing)} of {len(cells)} cells are there, {len(missing)} to do")
    failures: list[str] = []
    if missing:
        own = None if executor is not None else _local_processes(processes)
        try:
            futures: dict[Future[dict[str, Any]], Cell] = {
                (executor or own).submit(work, cell): cell  # type: ignore[union-attr]  # one of the two is there
                for cell in missing
            }
            for count, future in enumerate(as_completed(futures), 1):
                cell = futures[future]
                error = future.exception()
                if error is not None:
                    failures.append(f"{_key(cell)}: {error!r}")
                    say(f"failed: {failures[-1]}")
                    continue
                row = {"cell": cell, "result": future.result()}
                _append(path, row)
                done[_key(cell)] = row
                say(f"{count} of {len(missing)}: {_key(cell)}")
        finally:
            if own is not None:
                own.shutdown(cancel_futures=True)
    if failures:
        raise RuntimeError(f"{len(failures)} of {len(missing)} cells failed, the first one: {failures[0]}")
    return [done[key] for key in keys]


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
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            rows.append(json.loads(line))
        except ValueError as error:
            if number < len(lines):
                raise ValueError(f"{path}: line {number} is no JSON ({error})") from error
    whole = lines[: len(rows)]
    if whole and not whole[-1].endswith("\n"):
        whole[-1] += "\n"
    if repair and whole != lines:
        path.write_text("".join(whole), encoding="utf-8")
    return rows


def _local_processes(processes: int) -> ProcessPoolExecutor:
    threads = max(1, (os.cpu_count() or 1) // processes)
    return ProcessPoolExecutor(
        processes, multiprocessing.get_context("spawn"), initializer=_limit_threads, initargs=(threads,)
    )


def _limit_threads(threads: int) -> None:
    import torch

    torch.set_num_threads(threads)


def _key(cell: Cell) -> str:
    return json.dumps(cell, sort_keys=True)


def _append(path: Path, row: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row, sort_keys=True) + "\n")
        file.flush()
        os.fsync(file.fileno())
