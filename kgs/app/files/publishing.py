"""Whose file it is, and how new results get to their places; docs/command.md states the rules.

A folder of results has a marker, `.kgs.json`: the SHA-256 of what kgs wrote there, by kind of result and name. New
results are written to a folder of their own below it, which has a marker, too. `publish` moves them to their places;
after a kill the next command that opens the folder ends the move (`complete`).
"""

import errno
import hashlib
import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from itertools import chain, count
from pathlib import Path, PurePath
from typing import Any

from kgs._support.errors import DataError, listed, printable
from kgs._support.json_files import read_json, write_json
from kgs.app.console import say

from .locks import held

MARKER = ".kgs.json"
KEPT = "kept"
_UNFINISHED = re.compile(r"unfinished-[1-9]\d*")  # folders of new results that outlive their process
_HIDDEN = re.compile(r"\.kgs-[0-9a-f]{32}")  # those that do not
_TEMPORARY = re.compile(r"\.kgs-[0-9a-f]{32}\.tmp")  # files of `write_whole`, which a kill leaves
_LOCK = ".lock"
_MARKER_LOCK = ".kgs.lock"
_MAX_NAMED = 10  # files in a line
Hashes = dict[str, list[str]]  # of each file that kgs wrote; two where new results are about to replace former ones
Say = Callable[[str], None]


def begin(out: Path, kind: str) -> Path:
    """Make a folder for new results in `out`: `unfinished-1`, or the next number whose name is free."""
    out.mkdir(parents=True, exist_ok=True)
    with _marker_lock(out):
        hidden = _make_hidden(out)
        _write_marker(hidden, {kind: {}})
        work = next(path for number in count(1) if not os.path.lexists(path := out / f"unfinished-{number}"))
        os.rename(hidden, work)  # with its marker: without one it would be the user's
    return work


@contextmanager
def replacing(
    out: Path, kind: str, all_former: bool = False, keep_on_error: bool = False, say: Say = say
) -> Iterator[Path]:
    """A hidden folder for new files, which take their places in `out` when the block ends; see `publish`.

    `out` is created if it does not exist; after an error in the block it is as it was, but for the hidden folder with
    `keep_on_error`, which stays until the next call.
    """
    out.mkdir(parents=True, exist_ok=True)
    complete(out, say)
    with ExitStack() as lock:
        with _marker_lock(out):
            work = _make_hidden(out)
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
        publish(work, out, all_former, say)


def enter(work: Path, kind: str, names: Iterable[str] | None = None) -> None:
    """Enter files of a folder of new results in its marker, as they are now: these if they are there, or all."""
    former = read_marker(work).get(kind, {})
    there = _files(work) if names is None else [name for name in names if (work / name).is_file()]
    _write_marker(work, {kind: former | {name: [_sha256(work / name)] for name in there}})


def publish(work: Path, out: Path, all_former: bool, say: Say = say, along: Iterable[Path] = ()) -> None:
    """Move the files that a folder of new results has in its marker to their places in `out`.

    What is in the way and was not written there by a command of the same kind is moved to `out/kept`.

    Args:
        work: the folder of new results.
        out: where they belong.
        all_former: remove former results of this kind that the new ones do not have.
        say: gets a line that says what was moved to `kept`.
        along: other folders of new results, which replace all former ones of their kinds at the same time.
    """
    move = {"all_former": all_former, "along": [other.name for other in along]}
    write_json(work / MARKER, _read(work) | {"move": move})
    complete(out, say)


def complete(out: Path, say: Say = say) -> None:
    """End moves that a kill stopped, and remove hidden folders of processes that are gone; not where none can write."""
    if not any(_HIDDEN.fullmatch(work.name) or "move" in _read(work) for work in _works(out)):
        return
    with ExitStack() as lock:
        try:
            lock.enter_context(_marker_lock(out))
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
                return
            raise
        for work in _works(out):
            move = _read(work).get("move")
            if isinstance(move, dict):
                for other in _works(out):
                    if other.name in move.get("along", ()):
                        _move(other, out, True, say)
                _move(work, out, bool(move.get("all_former")), say)
            elif _HIDDEN.fullmatch(work.name):
                with held(work / _LOCK, unknown=False) as is_left:
                    if is_left:
                        shutil.rmtree(work, ignore_errors=True)


def unpublished(out: Path, kind: str) -> list[Path]:
    """The folders of new results of a kind in `out` that outlived their process, in the order of their numbers."""
    works = [work for work in _works(out) if _UNFINISHED.fullmatch(work.name) and kind in read_marker(work)]
    return sorted(works, key=lambda work: (len(work.name), work.name))


def discard(work: Path, names: Sequence[str] = (), say: Say = say) -> None:
    """Remove what kgs wrote in a folder of new results, `names` included, and the folder if nothing else is in it."""
    complete(work)
    entered = {name: shas for files in read_marker(work).values() for name, shas in files.items()}
    own = [name for name, shas in entered.items() if _in_the_way(work, name, shas) is None]
    temporary = [path.name for path in work.iterdir() if _TEMPORARY.fullmatch(path.name)]
    for name in (*own, *names, *temporary, _LOCK, _MARKER_LOCK):
        if not (work / name).is_dir():
            (work / name).unlink(missing_ok=True)
    for name in (*entered, *names):
        _remove_empty((work / name).parent, work)
    if any(path.name != MARKER for path in work.iterdir()):
        (work / MARKER).unlink(missing_ok=True)
        say(f"{printable(work)}: what is left there is not of kgs, and stays")
    else:
        hidden = _hidden_name(work.parent)
        os.rename(work, hidden)  # a kill leaves either of them
        shutil.rmtree(hidden, ignore_errors=True)


def is_own(folder: Path, *names: str) -> bool:
    """Whether all of these files in a folder of results are as kgs wrote them there."""
    kinds = read_marker(folder).values()
    hashes = {name: [sha for files in kinds for sha in files.get(name, ())] for name in names}
    return all(
        os.path.lexists(folder / name) and _in_the_way(folder, name, shas) is None for name, shas in hashes.items()
    )


def read_marker(folder: Path) -> dict[str, Hashes]:
    """The SHA-256 of what kgs wrote in a folder, by kind and name; empty if there is no marker, or it is damaged."""
    kinds = _read(folder).get("files")
    return {
        kind: {name: shas for name, shas in files.items() if isinstance(shas, list) and _is_below(name)}
        for kind, files in (kinds.items() if isinstance(kinds, dict) else ())
        if isinstance(files, dict)
    }


def _read(folder: Path) -> dict[str, Any]:
    try:
        return read_json(folder / MARKER)
    except DataError:
        return {}


def _write_marker(folder: Path, entries: dict[str, Hashes]) -> None:
    """Put entries in place of the former ones of their kinds. A link is not followed, and what is no marker is kept."""
    path = folder / MARKER
    content = {"files": read_marker(folder) | entries}
    if os.path.lexists(path) and "files" not in _read(folder):
        say(f"{printable(folder)}: moved to {_keep(folder, path)}, because it is no marker of kgs")
    if path.is_symlink():
        path.unlink()
    write_json(path, content)


def _make_hidden(out: Path) -> Path:
    work = _hidden_name(out)
    work.mkdir()
    return work


def _hidden_name(out: Path) -> Path:
    return out / f".kgs-{uuid.uuid4().hex}"


def _marker_lock(out: Path) -> AbstractContextManager[bool]:
    """Wait until no other process changes the marker of a folder."""
    return held(out / _MARKER_LOCK, wait=True)


def _works(out: Path) -> list[Path]:
    """The folders of new results in a folder."""
    found = [path for path in (*out.glob("unfinished-*"), *out.glob(".kgs-*")) if path.is_dir()]
    return [
        path
        for path in sorted(found)
        if not path.is_symlink() and (_UNFINISHED.fullmatch(path.name) or _HIDDEN.fullmatch(path.name))
    ]


def _move(work: Path, out: Path, all_former: bool, say: Say) -> None:
    """Move the files of a folder of new results to their places; a kill at any moment, and the next call ends it."""
    kind, new = next(iter(read_marker(work).items()), ("", {}))
    former = read_marker(out).get(kind, {})
    either = {name: [*former.get(name, ()), *new.get(name, ())] for name in {**former, **new}}
    _write_marker(out, {kind: either})  # whichever of the two a kill leaves is known
    waiting = [name for name in new if (work / name).is_file()]
    blocked = [path for name in waiting if (path := _in_the_way(out, name, either[name])) is not None]
    kept = [_keep(out, path) for path in dict.fromkeys(blocked)]
    if kept:
        reason = "because this command did not write it, or it was changed since"
        say(f"{printable(out)}: moved to {listed(kept, _MAX_NAMED)}, {reason}")
    for name in waiting:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(work / name, out / name)
    for name in former if all_former else ():
        if name not in new and _in_the_way(out, name, former[name]) is None:
            (out / name).unlink(missing_ok=True)
            _remove_empty((out / name).parent, out)
    _write_marker(out, {kind: new if all_former else former | new})
    if _HIDDEN.fullmatch(work.name):
        shutil.rmtree(work, ignore_errors=True)
    else:
        discard(work, say=say)


def _keep(out: Path, path: Path) -> str:
    """Move a file, folder or link to `kept`, or `kept-2` and so on where its name is taken; returns its new name."""
    name = path.relative_to(out).as_posix()
    folders = chain([KEPT], (f"{KEPT}-{number}" for number in count(2)))
    kept = next(f"{folder}/{name}" for folder in folders if _in_the_way(out, f"{folder}/{name}", ()) is None)
    (out / kept).parent.mkdir(parents=True, exist_ok=True)
    os.rename(path, out / kept)
    return kept


def _in_the_way(folder: Path, name: str, own: Iterable[str]) -> Path | None:
    """The user's file, folder or link in the place of a file, or in that of a folder above it; None: there is none."""
    path = folder / name
    above = [folder / part for part in reversed(PurePath(name).parents) if part.name]
    if blocked := next((part for part in above if part.is_symlink() or (part.exists() and not part.is_dir())), None):
        return blocked
    if not os.path.lexists(path):
        return None
    is_own = path.is_file() and not path.is_symlink() and _sha256(path) in own
    return None if is_own else path


def _files(folder: Path) -> list[str]:
    """The files of a folder of new results and its subfolders."""
    files = [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()]
    return [path.as_posix() for path in files if path.as_posix() not in (MARKER, _LOCK, _MARKER_LOCK)]


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _is_below(name: str) -> bool:
    """Whether a name in a marker is that of a file below its folder; a damaged marker may have others."""
    path = PurePath(name)
    return path.name != "" and not path.anchor and ".." not in path.parts


def _remove_empty(folder: Path, root: Path) -> None:
    """Remove a folder below `root`, and those above it, as far as they are empty."""
    while folder != root and not folder.is_symlink():
        if folder.is_dir():
            if any(folder.iterdir()):
                return
            folder.rmdir()
        folder = folder.parent
