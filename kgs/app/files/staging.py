"""Replaces former results by new ones all at once, whenever the process is killed.

Results are written to a folder of their own, `unfinished`. When all are there, `seal` lists the files and renames the
folder to `finished`; from then on they are whole. `complete` moves them to their places, removes what only the former
results had, and keeps the list, see `ownership.py`. Code that opens the folder calls `complete` first, in case a kill
came in between.
"""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path, PurePath

from .ownership import LIST, WAITING, Entries, holds_only_own, is_own, read_list, replace_entries, stamps


@dataclass(frozen=True)
class Staging:
    """The two folders through which results of one kind pass.

    Args:
        out: where the results belong.
        kind: of the results, a key of `WAITING`, which tells them apart from others in the same folder.
    """

    out: Path
    kind: str = "fit"

    @property
    def unfinished(self) -> Path:
        """Where new results are written."""
        return self.out / f"un{WAITING[self.kind]}"

    @property
    def finished(self) -> Path:
        """Where whole results wait until they are moved to `out`."""
        return self.out / WAITING[self.kind]

    @property
    def is_waiting(self) -> bool:
        """Whether whole results wait, none of which has been moved yet."""
        names = self._sealed()
        return bool(names) and all((self.finished / name).exists() for name in names)

    def start(self) -> None:
        """Make an empty folder for new results."""
        self._remove(self.unfinished)
        self.unfinished.mkdir(parents=True)
        replace_entries(self.unfinished, self.kind, {})

    def enter(self) -> None:
        """Enter the new results in the list of their own folder, where they stay."""
        replace_entries(self.unfinished, self.kind, stamps(self.unfinished, _files(self.unfinished)))

    def seal(self) -> None:
        """Declare the new results whole."""
        self.enter()
        self.discard()
        os.replace(self.unfinished, self.finished)

    def complete(self) -> None:
        """Move whole results to their places; does nothing if there are none."""
        new = self._sealed()
        if not new:
            if holds_only_own(self.finished):  # a kill came while it was removed
                self.discard()
            return
        former = read_list(self.out).get(self.kind, {})
        for name in former:
            path = self.out / name
            if name not in new and _is_below(name) and path.is_file() and is_own(path):
                path.unlink()
                _remove_empty(path.parent, self.out)
        for name in _files(self.finished):
            target = self.out / name
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(self.finished / name, target)
        replace_entries(self.out, self.kind, new)
        self.discard()

    def discard(self) -> None:
        """Remove whole results that wait."""
        self._remove(self.finished)

    def _remove(self, folder: Path) -> None:
        """Remove one of the two folders; until it is gone it has a list, which says that nothing in it is whole."""
        if not folder.exists():
            return
        replace_entries(folder, self.kind, {})
        for path in folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != LIST:
                path.unlink()
        shutil.rmtree(folder)

    def _sealed(self) -> Entries:
        """The entries of whole results, those that were moved before a kill included."""
        return read_list(self.finished).get(self.kind, {})


def _files(folder: Path) -> list[str]:
    """The files of a folder and its subfolders, without its list and those that a kill left half written."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix not in (".partial", ".tmp")]
    return [path.relative_to(folder).as_posix() for path in files if path.name != LIST]


def _is_below(name: str) -> bool:
    """Whether a name in a list leads to a place below its folder; a damaged list may have others."""
    path = PurePath(name)
    return not path.anchor and ".." not in path.parts


def _remove_empty(folder: Path, root: Path) -> None:
    """Remove a folder below `root` that has become empty, and those above it."""
    while folder != root and not folder.is_symlink() and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent
