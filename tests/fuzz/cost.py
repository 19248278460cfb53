"""Reads damaged files within bounds of time and memory."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from pathlib import Path

from kgs._support.errors import DataError

_SLOWEST, _MEMORY_FACTOR, _MEMORY = 1.0, 4, 64 * 2**20


def read_within_bounds(read: Callable[[Path], object], path: Path) -> str:
    """Read a file or a folder: "sound", or "refused" where it raises a DataError.

    Asserts that it takes less than a second (of two tries, because another program may take the core) and less memory
    than four times the files and 64 MiB. That is resident memory, which Linux alone can tell (`VmHWM`, reset through
    /proc/self/clear_refs): tracemalloc does not see what OpenCV, NumPy and PyTorch take.
    """
    files = path.rglob("*") if path.is_dir() else [path]
    allowed = _MEMORY_FACTOR * sum(file.stat().st_size for file in files if file.is_file()) + _MEMORY
    before = reset_peak()
    outcome, seconds = _timed(read, path)
    if before is not None:
        assert peak() - before < allowed
    if seconds >= _SLOWEST:
        seconds = _timed(read, path)[1]
    assert seconds < _SLOWEST
    return outcome


def _timed(read: Callable[[Path], object], path: Path) -> tuple[str, float]:
    start, outcome = time.perf_counter(), "sound"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            read(path)
        except DataError:
            outcome = "refused"
    return outcome, time.perf_counter() - start


def reset_peak() -> int | None:
    """Let the peak of the resident memory start again; the memory now, or None where the system cannot do that."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return None
    return _status("VmRSS")


def peak() -> int:
    """The largest memory since the last call of `reset_peak`."""
    return _status("VmHWM")


def _status(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(name))
