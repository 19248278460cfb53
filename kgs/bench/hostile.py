"""Damaged and hostile files against every reader: each must load sound numbers or raise DataError, at little cost.

Memory is the largest resident memory during a read, over what the process had before it. It is measured on Linux alone
(`VmHWM`, reset through /proc/self/clear_refs): tracemalloc would not see what OpenCV, NumPy and PyTorch take.
"""

from __future__ import annotations

import os
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kgs.errors import DataError
from kgs.fit.outputs import versions, write_json

from .file_readers import FILE_READERS
from .output import markdown_table, write_csv
from .readers import Reader
from .scene_readers import SCENE_READERS

__all__ = ["READERS", "Outcome", "measure_hostile", "try_reader"]

READERS: tuple[Reader, ...] = (*SCENE_READERS, *FILE_READERS)
_TRIALS, _QUICK_TRIALS = 1500, 100
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


def measure_hostile(out: Path, *, quick: bool = False, say: Callable[[str], None] = print) -> dict[str, Any]:
    """Try damaged files on every reader, and write hostile.csv, hostile.json and hostile.md.

    Args:
        out: folder for the results, made if it is not there.
        quick: fewer files, in 15 seconds instead of some 70.
        say: where lines for the user go.

    Returns:
        What hostile.json holds: "rows", one a reader, and "failures", each trial that broke a rule, in words.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows, failures = [], []
    for reader in READERS:
        outcomes = try_reader(reader, range(round((_QUICK_TRIALS if quick else _TRIALS) * reader.share)))
        rows.append(_row(reader, outcomes))
        failures += [outcome.what for outcome in outcomes if outcome.kind == "other" or not _is_cheap(outcome)]
        say(f"{reader.name}: {rows[-1]['tried']} tried, {rows[-1]['other']} other than sound or DataError")
    total = {key: sum(row[key] for row in rows) for key in ("tried", "sound", "DataError", "other")}
    result = {"rows": rows, "total": total, "failures": failures, "versions": versions()}
    write_csv(out / "hostile.csv", rows)
    write_json(out / "hostile.json", result)
    (out / "hostile.md").write_text(table := _markdown(rows, total), encoding="utf-8")
    say(table)
    return result


def try_reader(reader: Reader, seeds: Sequence[int]) -> list[Outcome]:
    """Damage a valid set of files once a seed and read it.

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
            outcome = _try(reader, folder, what)
            outcomes.append(
                outcome if outcome.seconds < _SLOWEST else min(outcome, _try(reader, folder, what), key=_time)
            )
            path.write_bytes(whole)
    return outcomes


def _try(reader: Reader, folder: Path, what: str) -> Outcome:
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


def _is_cheap(outcome: Outcome) -> bool:
    return outcome.seconds < _SLOWEST and (outcome.memory or 0) < outcome.allowed


def _row(reader: Reader, outcomes: list[Outcome]) -> dict[str, Any]:
    kinds = [outcome.kind for outcome in outcomes]
    memory = [outcome.memory for outcome in outcomes if outcome.memory is not None]
    return {
        "reader": reader.name,
        "tried": len(outcomes),
        "sound": kinds.count("sound"),
        "DataError": kinds.count("refused"),
        "other": kinds.count("other"),
        "slowest_s": round(max(outcome.seconds for outcome in outcomes), 4),
        "memory": max(memory, default=None),
        "allowed": min(outcome.allowed for outcome in outcomes),
    }


def _markdown(rows: list[dict[str, Any]], total: dict[str, int]) -> str:
    def mib(value: int | None) -> str:
        return "not measured" if value is None else f"{value / 2**20:.1f}"

    lines = [
        [
            r["reader"],
            r["tried"],
            r["sound"],
            r["DataError"],
            r["other"],
            r["slowest_s"],
            mib(r["memory"]),
            mib(r["allowed"]),
        ]
        for r in rows
    ]
    memory = max((row["memory"] for row in rows if row["memory"] is not None), default=None)
    lines.append(["all", *total.values(), max(row["slowest_s"] for row in rows), mib(memory), ""])
    title = (
        "Damaged files (seeded mutations of valid ones): loaded with sound numbers, refused with DataError, or other"
    )
    heads = ["tried", "loaded, sound", "DataError", "other", "slowest [s]", "memory [MiB]", "allowed [MiB]"]
    return markdown_table(title, heads, lines, first="reader")


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
