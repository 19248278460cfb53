"""Damaged and hostile files against every reader: each must load sound numbers or raise DataError, at little cost.

Memory is the largest resident memory during a read, over what the process had before it. It is measured on Linux alone
(`VmHWM`, reset through /proc/self/clear_refs): tracemalloc would not see what OpenCV, NumPy and PyTorch take.
"""

from __future__ import annotations

import os
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from readers import Reader

from kgs.errors import DataError

__all__ = ["Outcome", "is_cheap", "table_row", "try_files", "try_reader"]

_SLOWEST, _MEMORY_FACTOR, _MEMORY = 1.0, 4, 64 * 2**20


@dataclass(frozen=True)
class Outcome:
    """What a reader made of one damaged file.

    Args:
        kind: "sound" (it loaded, all numbers finite and valid), "refused" (DataError) or "other".
        what: reader, seed and damage in words, and the error unless it loaded.
        seconds: of the read; a read that took longer than allowed is repeated, and the less counts.
        memory: largest resident memory over what there was before, bytes; None where it cannot be measured.
        allowed: four times the files' bytes and 64 MiB.
    """

    kind: str
    what: str
    seconds: float
    memory: int | None
    allowed: int


def try_reader(reader: Reader, seeds: Sequence[int]) -> list[Outcome]:
    """Damage a valid set of files once per seed and read it.

    Raises:
        DataError: the reader refuses the undamaged files.
    """
    outcomes = []
    with tempfile.TemporaryDirectory() as name, _quiet():
        folder = Path(name)
        reader.write(folder)
        reader.read(folder)
        for seed in seeds:
            path, data, what = reader.damage(folder, seed)
            whole = path.read_bytes()
            path.write_bytes(data)
            outcome = try_files(reader, folder, what)
            outcomes.append(
                outcome if outcome.seconds < _SLOWEST else min(outcome, try_files(reader, folder, what), key=_time)
            )
            path.write_bytes(whole)
    return outcomes


def is_cheap(outcome: Outcome) -> bool:
    """Whether the read kept to the bounds of time and memory."""
    return outcome.seconds < _SLOWEST and (outcome.memory or 0) < outcome.allowed


def table_row(reader: Reader, outcomes: list[Outcome]) -> dict[str, Any]:
    """What `tables.py` shows of one reader."""
    kinds = [outcome.kind for outcome in outcomes]
    memory = [outcome.memory for outcome in outcomes if outcome.memory is not None]
    return {
        "name": reader.name,
        "trials": len(outcomes),
        "sound": kinds.count("sound"),
        "DataError": kinds.count("refused"),
        "other": kinds.count("other"),
        "slowest_s": round(max(outcome.seconds for outcome in outcomes), 4),
        "memory": max(memory, default=None),
        "allowed": min(outcome.allowed for outcome in outcomes),
    }


def try_files(reader: Reader, folder: Path, what: str) -> Outcome:
    """Read the files as they are."""
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    before, start, kind = _reset_peak(), time.perf_counter(), "sound"
    try:
        reader.read(folder)
    except DataError as error:
        kind, what = "refused", f"{what}: {error}"
    except Exception as error:  # any other one is what this program looks for
        kind, what = "other", f"{what}: {error!r}"
    seconds, peak = time.perf_counter() - start, _status("VmHWM")
    memory = None if before is None or peak is None else peak - before
    return Outcome(kind, what, seconds, memory, _MEMORY_FACTOR * size + _MEMORY)


def _time(outcome: Outcome) -> float:
    return outcome.seconds


def _reset_peak() -> int | None:
    """Let the peak of the resident memory begin anew; the memory now, or None where the system cannot do that."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return None
    return _status("VmRSS")


def _status(name: str) -> int | None:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(name)), None)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without warnings: Python's, and those that the image libraries write to the error stream of the process."""
    kept = os.dup(2)
    with warnings.catch_warnings(), open(os.devnull, "w") as nowhere:
        warnings.simplefilter("ignore")
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
