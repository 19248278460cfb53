"""The folder of a fit: one fit at a time, and an old result that stays whole until the new one is.

A fit writes to `unfinished`, its checkpoints included. When all is there the folder is renamed to `finished`, and its
files are moved to their places. Whoever opens the folder after a kill in between ends the move first.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from kgs.errors import DataError
from kgs.json_files import read_json

from .checkpoint import previous
from .outputs import remove_others, write_json

__all__ = ["CHECKPOINT", "RESULTS", "UNFINISHED", "end_move", "is_finished", "locked", "publish", "recover"]

CHECKPOINT = "checkpoint.safetensors"
RESULTS = ("config.json", "metrics.json", "splat.ply", "curve.png")
UNFINISHED, _FINISHED = "unfinished", "finished"
_LIST = "files.json"  # all files of the new result
_OPTIONAL = (previous(Path(CHECKPOINT)).name, "checkpoint.pt", "checkpoint.previous.pt")  # the latter of older versions


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Keep other fits out of a folder until the block or the process ends, however it ends.

    Raises:
        DataError: another fit is at work in the folder.
    """
    with open(out / ".lock", "ab") as file:
        try:
            if sys.platform == "win32":
                import msvcrt

                file.seek(0)
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as error:
            raise DataError(
                out, "", "another fit is at work in this folder: wait for it or choose another --out"
            ) from error
        except OSError:
            pass  # a file system without locks
        yield


def publish(out: Path) -> None:
    """Put the results in `unfinished` in the place of those of a former fit.

    Raises:
        OSError: a file cannot be moved; what is missing is moved by the next `end_move`.
    """
    new = out / UNFINISHED
    write_json(new / _LIST, {"files": _results(new)})
    shutil.rmtree(out / _FINISHED, ignore_errors=True)
    os.replace(new, out / _FINISHED)
    end_move(out)


def recover(out: Path) -> None:
    """End the move that a kill stopped, if there is one."""
    if (out / _FINISHED / _LIST).exists():
        with locked(out):
            end_move(out)


def end_move(out: Path) -> None:
    """The same within `locked`: what is left goes to its place, and what belonged to the result before goes away."""
    done = out / _FINISHED
    if not (done / _LIST).exists():
        return
    names = [str(name) for name in read_json(done / _LIST).get("files", [])]  # of the moved ones as well
    (out / "test").mkdir(exist_ok=True)
    remove_others(out / "test", {Path(name).name for name in names if name.startswith("test/")})
    for name in _OPTIONAL:
        if name not in names:
            (out / name).unlink(missing_ok=True)
    for name in _results(done):
        os.replace(done / name, out / name)
    shutil.rmtree(done)


def _results(folder: Path) -> list[str]:
    """The files of a result, without what a kill left half written."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != _LIST]
    return [path.relative_to(folder).as_posix() for path in files if path.name[0] != "." and path.suffix != ".partial"]


def is_finished(out: Path) -> bool:
    """Whether the folder has the results of a fit that did all its steps."""
    try:
        return bool(read_json(out / "metrics.json")["steps"] >= read_json(out / "config.json")["fit"]["steps"])
    except (DataError, KeyError, TypeError):
        return False
