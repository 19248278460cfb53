"""The files of a fit, and which of several fits in a folder is the furthest."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from kgs._support.errors import DataError
from kgs._support.json_files import read_json

from .publishing import discard, unpublished

CHECKPOINT = "checkpoint.safetensors"
PREVIOUS = "checkpoint.previous.safetensors"


def is_finished(out: Path) -> bool:
    """Whether the folder has the results of a fit that did all its steps."""
    try:
        return bool(read_json(out / "metrics.json")["steps"] >= read_json(out / "config.json")["schedule"]["steps"])
    except (DataError, KeyError, TypeError):
        return False


def step_of(folder: Path) -> int:
    """How many steps the fit in a folder did, by its results or its checkpoint; -1 if it has neither."""
    from kgs.fit.checkpoint import newest_checkpoint  # here, because it loads torch

    steps = [-1]
    with suppress(DataError, KeyError, TypeError, ValueError):
        steps.append(int(read_json(folder / "metrics.json")["steps"]))
    with suppress(DataError, KeyError, TypeError, ValueError):
        steps.append(int(newest_checkpoint(folder / CHECKPOINT)[0]["step"]))
    return max(steps)


def resumable_fits(out: Path) -> list[Path]:
    """The folders of fits in `out` with a checkpoint, `out` included, the furthest first; a finished one only alone."""
    folders = [*unpublished(out, "fit"), out]
    found = [folder for folder in folders if any((folder / name).exists() for name in (CHECKPOINT, PREVIOUS))]
    if len(found) > 1 and found[-1] == out and is_finished(out):
        found.pop()
    return sorted(found, key=step_of, reverse=True)


def discard_fit(work: Path, say: Callable[[str], None]) -> None:
    """Remove a fit that was not published; files that kgs does not know stay."""
    discard(work, (CHECKPOINT, PREVIOUS, f"{CHECKPOINT}.partial"), say)
