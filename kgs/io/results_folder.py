"""The folder of a fit: one fit at a time, and an old result that stays whole until the new one is.

A fit writes to `unfinished`, its checkpoints included. When all is there the folder is renamed to `finished`, and its
files are moved to their places. Whoever opens the folder after a kill in between ends the move first.
"""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from kgs.errors import DataError

from .json_files import read_json, write_json
from .outputs import EXPORTS, is_own, remove_others

CHECKPOINT, PREVIOUS = "checkpoint.safetensors", "checkpoint.previous.safetensors"
RESULTS = ("config.json", "metrics.json", "splat.ply", "curve.png", "index.html", *EXPORTS)
UNFINISHED, _FINISHED = "unfinished", "finished"
_LIST = "files.json"  # all files of the new result
_OPTIONAL = (PREVIOUS, "turntable.webm")


@contextmanager
def held(path: Path) -> Iterator[bool]:
    """Hold a file, made if it is not there, until the block or the process ends; False where another one has it."""
    with open(path, "ab") as file:
        ours = True
        try:
            if sys.platform == "win32":
                import msvcrt

                file.seek(2**30)  # behind its end: what is locked cannot be read
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            ours = False
        except OSError:
            pass  # a file system without locks
        yield ours


def previous(path: Path) -> Path:
    """Where the checkpoint before the one at `path` is."""
    return path.with_name(f"{path.stem}.previous{path.suffix}")


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Keep other fits out of a folder until the block or the process ends; DataError where one is at work there."""
    with held(out / ".lock") as ours:
        if not ours:
            raise DataError(out, "", "another fit is at work in this folder: wait for it or choose another folder")
        yield


def taken(out: Path) -> list[str]:
    """What a fit replaces or removes in its folder; checkpoints, which may be damaged, only where there is no fit."""
    names = [*RESULTS, UNFINISHED, _FINISHED]
    return names if is_own(out / "config.json") else [*names, CHECKPOINT, *_OPTIONAL]


def publish(out: Path) -> None:
    """Put the results in `unfinished` in the place of a former fit's; what fails to move, the next `end_move` moves."""
    new = out / UNFINISHED
    write_json(new / _LIST, {"files": _results(new)})
    shutil.rmtree(out / _FINISHED, ignore_errors=True)
    os.replace(new, out / _FINISHED)
    end_move(out)


def end_move(out: Path) -> None:
    """Within `locked`: what is left of a move goes to its place, what belonged to the former result goes away."""
    done = out / _FINISHED
    if not (is_own(done) and (done / _LIST).exists()):
        return
    names = [str(name) for name in read_json(done / _LIST).get("files", [])]  # of the moved ones as well
    (out / "test").mkdir(exist_ok=True)
    remove_others(out / "test", {Path(name).name for name in names if name.startswith("test/")})
    for name in set(_OPTIONAL) - set(names):
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


def end_stopped_move(out: Path) -> None:
    """End the move of a fit that a kill stopped, if there is one."""
    if (out / _FINISHED / _LIST).exists():
        with locked(out):
            end_move(out)
