"""The results folder of a fit: its files, its lock, and whether the fit is finished."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from kgs.errors import DataError
from kgs.json_files import read_json

from .outputs import EXPORTS
from .ownership import is_own
from .staging import Staging

CHECKPOINT = "checkpoint.safetensors"
PREVIOUS = "checkpoint.previous.safetensors"
_CHECKPOINTS = (CHECKPOINT, PREVIOUS)
RESULTS = ("config.json", "metrics.json", "splat.ply", "curve.png", "index.html", *EXPORTS, *_CHECKPOINTS)


@contextmanager
def held(path: Path) -> Iterator[bool]:
    """Lock a file, created if missing, until the block or the process ends; yields False if it is locked already."""
    with open(path, "ab") as file:
        ours = True
        try:
            if sys.platform == "win32":
                import msvcrt

                file.seek(2**30)  # beyond its end, because Windows forbids to read locked bytes
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            ours = False
        except OSError:
            pass  # a file system without locks
        yield ours


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Keep other fits out of a folder until the block or the process ends; DataError if one is at work there."""
    with held(out / ".lock") as ours:
        if not ours:
            raise DataError(out, "", "another fit is at work in this folder: wait for it or choose another folder")
        yield


def replaced_files(out: Path) -> list[str]:
    """The files that a fit replaces or removes in its folder, for `check_folder`.

    In the folder of a fit checkpoints are left out: a damaged one is no longer as kgs wrote it.
    """
    staging = Staging(out)
    is_of_fit = is_own(out / "config.json")
    files = [name for name in RESULTS if not (is_of_fit and name in _CHECKPOINTS)]
    return [*files, staging.unfinished.name, staging.finished.name]


def is_finished(out: Path) -> bool:
    """Whether the folder has the results of a fit that did all its steps."""
    try:
        return bool(read_json(out / "metrics.json")["steps"] >= read_json(out / "config.json")["fit"]["steps"])
    except (DataError, KeyError, TypeError):
        return False


def photo_staging(out: Path) -> Staging:
    """How unposed photos and their cameras get to their folder."""
    return Staging(out, "photos")


def complete_move(out: Path) -> None:
    """Move whole results of a fit to their places, and before them the photos and cameras that waited for it."""
    staging = Staging(out)
    if _is_of_own_photos(staging.finished):
        photo_staging(out).complete()
    staging.complete()


def complete_stopped_move(out: Path) -> None:
    """Complete the move of a fit's results that a kill stopped, if there is one."""
    if Staging(out).finished.exists():
        with locked(out):
            complete_move(out)


def _is_of_own_photos(folder: Path) -> bool:
    """Whether the scene of a fit is in the folder of its results."""
    try:
        return bool(read_json(folder / "config.json")["request"]["scene"] == ".")
    except (DataError, KeyError, TypeError):
        return False
