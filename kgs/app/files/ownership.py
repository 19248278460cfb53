"""Tells files of kgs from the user's by a list, `.kgs.json`, which each folder of results keeps.

The list holds name, size and modification time of each file that kgs wrote there, by kind of result. A file that is not
in it, or that was changed since, is the user's, and kgs neither overwrites nor removes it.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from kgs.errors import DataError
from kgs.json_files import read_json, write_json

LIST = ".kgs.json"
WAITING = {"fit": "finished", "photos": "finished-photos", "demo": "finished-demo"}  # folders by kind, see `staging.py`
_DEPTH = 3  # levels of folders between a file and the list that names it
Entries = dict[str, Any]  # [size, modification time in ns] by name; None: about to be written


def is_own(path: Path) -> bool:
    """Whether kgs wrote this file, and nothing has changed it since; an own folder has a list, or own files alone."""
    if path.is_dir():
        return not path.is_symlink() and ((path / LIST).is_file() or holds_only_own(path))
    if not path.is_file():
        return False
    for folder in path.absolute().parents[:_DEPTH]:
        name = path.absolute().relative_to(folder).as_posix()
        for entries in (*read_list(folder).values(), *_waiting(folder)):
            if name in entries and entries[name] in (None, _stamp(path)):
                return True
    return False


def holds_only_own(folder: Path) -> bool:
    """Whether kgs wrote all files of a folder and its subfolders; hidden files do not count."""
    if not folder.is_dir() or folder.is_symlink():
        return False
    files = [path for path in folder.rglob("*") if path.is_file() and path.name[0] != "."]
    return all(map(is_own, files))


def read_list(folder: Path) -> dict[str, Entries]:
    """The list of a folder, not to be changed: entries by kind of result; empty if there is none, or it is damaged."""
    path = folder.absolute() / LIST
    try:
        status = path.stat()
        return _read(path, status.st_ino, status.st_size, status.st_mtime_ns)
    except (DataError, OSError):
        return {}


@contextmanager
def writing(folder: Path, kind: str, names: Iterable[str]) -> Iterator[None]:
    """Enter the files that the block writes: before it, since a killed process leaves them, and as they are after it.

    What a block that fails did not write is in the list no longer.
    """
    names = list(names)
    replace_entries(folder, kind, read_list(folder).get(kind, {}) | dict.fromkeys(names))
    try:
        yield
    finally:
        others = {name: entry for name, entry in read_list(folder).get(kind, {}).items() if name not in names}
        written = [name for name in names if (folder / name).is_file()]
        replace_entries(folder, kind, others | stamps(folder, written))


def replace_entries(folder: Path, kind: str, entries: Entries) -> None:
    """Put entries in place of all former ones of a kind."""
    write_json(folder / LIST, read_list(folder) | {kind: entries})
    _read.cache_clear()


def stamps(folder: Path, names: Iterable[str]) -> Entries:
    """Entries of files that are there."""
    return {name: _stamp(folder / name) for name in names}


@lru_cache(maxsize=16)
def _read(path: Path, *_: int) -> dict[str, Entries]:
    """A list as it is at a time: it is read once for all files that are looked for in it."""
    return {kind: entries for kind, entries in read_json(path).items() if isinstance(entries, dict)}


def _stamp(path: Path) -> list[int]:
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _waiting(folder: Path) -> Iterable[Entries]:
    """Entries of whole results that a kill kept from being moved to this folder, or from being entered in its list."""
    for waiting in WAITING.values():
        yield from read_list(folder / waiting).values()
