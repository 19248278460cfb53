"""A folder of results: which folders may become one, and how new results take the place of former ones.

A folder of results has a marker, `.kgs.json`, with the names of its files by kind of result. New results are written to
one folder below it. When all are there, that folder is renamed to `.kgs-whole`, and its files are moved, one
`os.replace` each. A kill before the rename leaves the former results; after it, the next command moves what is left.
"""

import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Self

from kgs._support.errors import DataError, listed
from kgs._support.json_files import read_json, write_json

from .fit_files import NAMES, TEMPORARY, UNFINISHED, has_fit

if TYPE_CHECKING:
    from filelock import BaseFileLock

MARKER = ".kgs.json"
_LOCK = ".kgs.lock"
_NEW = ".kgs-new"  # of other new results
_WHOLE = ".kgs-whole"


class Results:
    """A folder of results, held by one command at a time; nothing is made before there is a result."""

    def __init__(self, out: Path, kind: str) -> None:
        self.out = out
        self.work = out / UNFINISHED
        self._kind = kind
        self._is_new = not out.exists()
        self._lock: BaseFileLock | None = None

    @classmethod
    @contextmanager
    def open(
        cls, out: Path, kind: str, beside: Sequence[str] = (), resume: bool = True, marks: Sequence[str] = ()
    ) -> Iterator[Self]:
        """Hold a folder for results until the block ends: one that is new, empty, or has results of this kind.

        The kind is "fit", "photos", "renders", "scale", "bench" or "study", of which others may be `beside` it; `marks`
        are files that tell a folder of results as its marker does. With `resume` an unfinished fit may be there. A
        DataError about another folder, one that cannot be written to, or one where kgs is at work.
        """
        _check_folder(out, {MARKER, *marks})
        if others := sorted(set(read_marker(out)).difference([kind, *beside])):
            raise DataError(out, "", f"a folder for {kind}", f"one of kgs with {' and '.join(others)}")
        results = cls(out, kind)
        try:
            if (out / MARKER).exists():
                results.begin()
            if not resume and has_fit(results.work):
                raise DataError(results.work, "", "no fit", "one that is not done", advice="use --resume, or remove it")
            yield results
        finally:
            results._close()

    def begin(self) -> None:
        """Make, lock and mark the folder, and end what a kill left of a move."""
        if self._lock is not None:
            return
        from filelock import FileLock, Timeout  # here, because it takes 0.15 s

        self.out.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.out / _LOCK)
        try:
            lock.acquire(timeout=0)
        except Timeout as error:
            raise DataError(self.out, "", "a free folder", "one in which kgs is at work") from error
        self._lock = lock
        if not (self.out / MARKER).exists():
            write_json(self.out / MARKER, {"files": {}})
        shutil.rmtree(self.out / _NEW, ignore_errors=True)
        self._move()

    @contextmanager
    def stage(self, keep: bool = False) -> Iterator[Path]:
        """A hidden folder for new files, which all get into `out` when the block ends; after an error none does.

        Former results of this kind that the new ones lack are removed, unless `keep`.
        """
        self.begin()
        new = self.out / _NEW
        new.mkdir()
        try:
            yield new
            former = read_marker(self.out).get(self._kind, []) if keep else []
            write_json(new / MARKER, {"files": {self._kind: sorted({*_files_in(new), *former})}})
        except BaseException as error:
            shutil.rmtree(new, ignore_errors=True)
            if isinstance(error, OSError) and error.filename:  # of a file that is gone
                error.filename = str(error.filename).replace(str(new), str(self.out))
            raise
        os.rename(new, self.out / _WHOLE)
        self._move()

    def publish(self, *kinds: str) -> None:
        """Move the results of these kinds from `work` to `out`; former ones that the new ones lack are removed."""
        write_json(self.work / MARKER, {"files": {kind: _files_in(self.work, NAMES[kind]) for kind in kinds}})
        os.rename(self.work, self.out / _WHOLE)
        self._move()

    def discard(self, *kinds: str) -> None:
        """Remove the results of these kinds from `work`, and `work` if nothing else is in it."""
        for kind in kinds:
            _remove(self.work, _files_in(self.work, (*NAMES[kind], *TEMPORARY)))
        if not _files_in(self.work):
            shutil.rmtree(self.work, ignore_errors=True)

    def _move(self) -> None:
        """Move the files of a whole folder of new results; after a kill at any moment the next call goes on."""
        whole = self.out / _WHOLE
        if not whole.is_dir():
            return
        former = read_marker(self.out)
        new = read_marker(whole)
        moved = [name for names in new.values() for name in names]
        for name in (name for name in moved if (whole / name).is_file()):
            (self.out / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(whole / name, self.out / name)
        for kind, names in new.items():
            _remove(self.out, {*former.get(kind, [])}.difference(names))
        write_json(self.out / MARKER, {"files": former | new})
        (whole / MARKER).unlink(missing_ok=True)
        _remove(whole, moved + _files_in(whole, (*TEMPORARY, *NAMES["fit"], *NAMES["photos"])))
        if _files_in(whole):  # the user's, in `work`
            os.rename(whole, self.work)
        else:
            shutil.rmtree(whole, ignore_errors=True)

    def _close(self) -> None:
        """Unlock the folder; one without results goes."""
        if self._lock is None:
            return
        if {path.name for path in self.out.iterdir()} <= {MARKER, _LOCK} and not any(read_marker(self.out).values()):
            (self.out / MARKER).unlink(missing_ok=True)
            (self.out / _LOCK).unlink()
            if self._is_new:
                self.out.rmdir()
        self._lock.release()


def complete(out: Path) -> None:
    """End what a kill left of a move, for a command that only reads; not where none can write."""
    if (out / _WHOLE).is_dir() and os.access(out, os.W_OK):
        results = Results(out, "")
        results.begin()
        results._close()


def read_marker(folder: Path) -> dict[str, list[str]]:
    """The names of kgs's files in a folder, by kind; empty if there is no marker; a DataError if it is damaged."""
    path = folder / MARKER
    if not os.path.lexists(path):
        return {}
    with suppress(DataError, TypeError, AttributeError, KeyError):
        kinds = {kind.partition(" ")[0]: [*names] for kind, names in read_json(path)["files"].items()}
        paths = [PurePath(name) for names in kinds.values() for name in names]
        if all(path.name and not path.anchor and ".." not in path.parts for path in paths):
            return kinds
    raise DataError(path, "", "a marker of kgs", "another file", advice="remove it, or choose another folder")


def _check_folder(out: Path, marks: set[str]) -> None:
    """Refuse a folder that cannot be written to, or that holds anything but results of kgs."""
    there = next(path for path in (out, *out.absolute().parents) if os.path.lexists(path))
    if not there.is_dir():
        raise DataError(out, "", "a folder for results", f"{there}, which is none")
    if not os.access(there, os.W_OK | os.X_OK):
        raise DataError(out, "", "a folder that can be written to", f"no permission for {there}")
    names = sorted(path.name for path in out.iterdir() if path.name != _LOCK) if out.is_dir() else []
    if names and marks.isdisjoint(names):
        raise DataError(out, "", "a new or empty folder, or one of kgs", f"one with {listed(names, 10)}")


def _files_in(folder: Path, patterns: Iterable[str] = ("*",)) -> list[str]:
    """The files of a folder and its subfolders whose names match, but for its marker."""
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())
    return [name for name in names if name != MARKER and any(fnmatchcase(name, pattern) for pattern in patterns)]


def _remove(folder: Path, names: Iterable[str]) -> None:
    """Remove these files, and the folders between that are then empty."""
    for name in names:
        (folder / name).unlink(missing_ok=True)
        for part in PurePath(name).parents[:-1]:
            with suppress(OSError):  # there is something in it
                (folder / part).rmdir()
