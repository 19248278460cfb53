"""Whose file it is, and how new results replace former ones; docs/command.md states the rules.

A folder of results has a marker, `.kgs.json`: the SHA-256 of each file that kgs wrote there, by kind of result and
name. New results are written to a folder below it, are entered in the marker of that folder, and replace the former
ones by renames. That marker says when they begin (`move`), and is removed after the one above has the new names. So
after a kill all files are known, and the next command that opens the folder ends the renames (`complete`).
"""

import hashlib
import os
import re
import shutil
import uuid
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path, PurePath
from typing import Any

from kgs._support.errors import DataError, listed
from kgs._support.json_files import read_json, write_json

from .locks import held

MARKER = ".kgs.json"
UNFINISHED = "unfinished"  # the folder of a fit and of cameras until the fit is done; it outlives its process
_STAGING = re.compile(r"\.kgs-[0-9a-f]{32}")  # folders of new results that do not
_TEMPORARY = re.compile(r"\.kgs-[0-9a-f]{32}\.tmp")  # files of `write_whole`, which a kill leaves
_LOCK = ".lock"
_MARKER_LOCK = ".kgs.lock"
_MAX_NAMED = 10  # files in a line
Hashes = dict[str, str]  # SHA-256 by the name of a file


def check_free(out: Path, kind: str, names: Iterable[str]) -> None:
    """Raise a DataError if results of these names would replace what no command of this kind wrote in `out`."""
    complete(out)
    own = read_marker(out).get(kind, {})
    _check_free(out, {name: [own.get(name)] for name in names})


@contextmanager
def replacing(out: Path, kind: str, all_former: bool = False, keep_on_error: bool = False) -> Iterator[Path]:
    """A hidden folder for new files, which get into `out` when the block ends; see `publish`.

    `out` is created if it does not exist; after an error in the block it is as it was, but for the hidden folder with
    `keep_on_error`, which stays until the next call.
    """
    out.mkdir(parents=True, exist_ok=True)
    complete(out)
    with ExitStack() as lock:
        with _marker_lock(out):
            work = out / f".kgs-{uuid.uuid4().hex}"
            work.mkdir()
            lock.enter_context(held(work / _LOCK))
        try:
            yield work
            enter(work, kind)
        except BaseException as error:
            if not keep_on_error:
                shutil.rmtree(work, ignore_errors=True)
                if isinstance(error, OSError) and error.filename:  # of a file that is gone
                    error.filename = str(error.filename).replace(str(work), str(out))
            raise
        publish(work, out, all_former)


def enter(work: Path, kind: str, names: Iterable[str] | None = None) -> None:
    """Enter files of a folder of new results in its marker, as they are now: these if they are there, or all."""
    files = read_marker(work)
    there = _files(work) if names is None else [name for name in names if (work / name).is_file()]
    _write_marker(work, files | {kind: files.get(kind, {}) | {name: _sha256(work / name) for name in there}})


def publish(work: Path, out: Path, all_former: bool = True) -> None:
    """Move the files that a folder of new results has in its marker to `out`, the folder above it.

    With `all_former`, former results of these kinds that the new ones do not have are removed.

    Raises:
        DataError: something that kgs did not write has the name of a new result. Nothing is replaced then; `complete`
            moves the new results once it is away.
    """
    write_json(work / MARKER, {"files": read_marker(work), "move": "replace" if all_former else "add"})
    complete(out)


def complete(out: Path) -> None:
    """End moves that a kill stopped, and remove hidden folders of processes that are gone; not where none can write."""
    if not any(_STAGING.fullmatch(work.name) or _is_moved(work) for work in _works(out)) or not os.access(out, os.W_OK):
        return
    with _marker_lock(out):
        for work in _works(out):
            if _is_moved(work):
                _move(work, out)
            elif _STAGING.fullmatch(work.name):
                with held(work / _LOCK, unknown=False) as is_left:
                    if is_left:
                        shutil.rmtree(work, ignore_errors=True)


def discard(work: Path, kind: str, names: Iterable[str] = ()) -> None:
    """Remove what kgs wrote of a kind in an unfinished folder, and the folder if nothing else is in it.

    `names` are those of files that are not in its marker.
    """
    complete(work)
    files = read_marker(work)
    _remove_own(work, files.pop(kind, {}))
    for name in names:
        (work / name).unlink(missing_ok=True)
    if files:
        _write_marker(work, files)
    else:
        _remove_marker(work)


def is_own(folder: Path, *names: str) -> bool:
    """Whether all of these files in a folder of results are as kgs wrote them there."""
    kinds = read_marker(folder).values()
    return all(
        os.path.lexists(folder / name) and _in_the_way(folder, name, [files.get(name) for files in kinds]) is None
        for name in names
    )


def read_marker(folder: Path) -> dict[str, Hashes]:
    """The SHA-256 of what kgs wrote in a folder, by kind and name; empty if there is no marker.

    Raises:
        DataError: the marker is damaged, a link, or a file of the user.
    """
    files: dict[str, Hashes] = _read(folder).get("files", {})
    return files


def _read(folder: Path) -> dict[str, Any]:
    """The content of a marker; see `read_marker`."""
    path = folder / MARKER
    if not os.path.lexists(path):
        return {}
    with suppress(DataError):
        content = read_json(path)
        if _is_marker(content.get("files")) and not path.is_symlink():
            return content
    advice = "remove it, or choose another folder for results"
    raise DataError(path, "", "a marker of this version of kgs", "another file", advice=advice)


def _is_marker(kinds: Any) -> bool:
    """Whether a value of JSON has hashes by kind and name, of files below the folder alone."""
    if not isinstance(kinds, dict) or not all(isinstance(files, dict) for files in kinds.values()):
        return False
    entries = [entry for files in kinds.values() for entry in files.items()]
    paths = [PurePath(name) for name, _ in entries]
    are_below = all(path.name and not path.anchor and ".." not in path.parts for path in paths)
    return are_below and all(isinstance(sha, str) for _, sha in entries)


def _write_marker(folder: Path, files: dict[str, Hashes]) -> None:
    write_json(folder / MARKER, {"files": files})


def _is_moved(work: Path) -> bool:
    """Whether the files of a folder of new results are being moved."""
    with suppress(DataError):  # another process may have removed it
        return "move" in _read(work)
    return False


def _marker_lock(out: Path) -> AbstractContextManager[bool]:
    """Wait until no other process changes the marker of a folder."""
    return held(out / _MARKER_LOCK, wait=True)


def _works(out: Path) -> list[Path]:
    """The folders of new results in a folder."""
    staging = [path for path in sorted(out.glob(".kgs-*")) if _STAGING.fullmatch(path.name)]
    return [path for path in (out / UNFINISHED, *staging) if path.is_dir() and not path.is_symlink()]


def _move(work: Path, out: Path) -> None:
    """Move the files of a folder of new results to `out`; a kill at any moment, and the next call ends it."""
    former = read_marker(out)
    new = read_marker(work)
    all_former = _read(work)["move"] == "replace"
    own = {
        name: [sha, former.get(kind, {}).get(name)]  # whichever of the two a kill left
        for kind, files in new.items()
        for name, sha in files.items()
        if (work / name).is_file()
    }
    _check_free(
        out, own, f"the new results wait in {work.name}, and the next command here then replaces the former ones"
    )
    for name in own:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(work / name, out / name)
    for kind, files in new.items():
        others = {name: sha for name, sha in former.get(kind, {}).items() if name not in files}
        if all_former:
            _remove_own(out, others)
        former[kind] = files if all_former else others | files
    _write_marker(out, former)
    if _STAGING.fullmatch(work.name):
        shutil.rmtree(work, ignore_errors=True)
    else:
        for files in new.values():
            _remove_own(work, files)  # what is left are empty folders
        _remove_marker(work)


def _check_free(out: Path, own: dict[str, list[str | None]], advice: str = "or choose another folder") -> None:
    """Raise a DataError if something in `out` has one of these names and none of its SHA-256."""
    blocked = [path for name, shas in own.items() if (path := _in_the_way(out, name, shas)) is not None]
    if blocked:
        names = listed([path.relative_to(out).as_posix() for path in dict.fromkeys(blocked)], _MAX_NAMED)
        expected = "nothing that this command did not write, or that was changed since"
        raise DataError(out, "", expected, names, advice=f"move it away, {advice}")


def _in_the_way(folder: Path, name: str, own: Iterable[str | None]) -> Path | None:
    """The user's file, folder or link that has the name of a file, or of a folder above it; None: there is none."""
    path = folder / name
    above = [folder / part for part in reversed(PurePath(name).parents) if part.name]
    if blocked := next((part for part in above if part.is_symlink() or (part.exists() and not part.is_dir())), None):
        return blocked
    if not os.path.lexists(path):
        return None
    is_own = path.is_file() and not path.is_symlink() and _sha256(path) in own
    return None if is_own else path


def _remove_own(folder: Path, files: Hashes) -> None:
    """Remove files that are as kgs wrote them, and the folders between that are then empty."""
    for name, sha in files.items():
        if _in_the_way(folder, name, [sha]) is None:
            (folder / name).unlink(missing_ok=True)
            for part in PurePath(name).parents[:-1]:
                with suppress(OSError):  # there is something in it
                    (folder / part).rmdir()


def _remove_marker(work: Path) -> None:
    """Remove marker and locks of an unfinished folder that has no results, and the folder if nothing else is in it."""
    complete(work)
    for path in [*work.glob(".kgs-*.tmp"), work / _MARKER_LOCK, work / MARKER]:
        if path.name in (_MARKER_LOCK, MARKER) or _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)
    with suppress(OSError):  # there is something of the user in it
        work.rmdir()


def _files(work: Path) -> list[str]:
    """The files of a folder of new results and its subfolders."""
    files = [path.relative_to(work) for path in sorted(work.rglob("*")) if path.is_file()]
    return [path.as_posix() for path in files if path.as_posix() not in (MARKER, _LOCK, _MARKER_LOCK)]


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
