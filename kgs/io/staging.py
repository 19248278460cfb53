"""Replaces former results by new ones all at once, whenever the process is killed.

Results are written to a folder of their own, `unfinished`. When all are there, `seal` lists the files and renames the
folder to `finished`; from then on they are whole. `complete` moves them to their places, and removes what only
the former results had. Code that opens the folder calls `complete` first, in case a kill came in between.
"""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from kgs.errors import DataError
from kgs.json_files import read_json, write_json

from .ownership import is_own, make_own_folder, remove_own_images

_LIST = "files.json"


@dataclass(frozen=True)
class Staging:
    """The two folders through which results of one kind pass.

    Args:
        out: where the results belong.
        kind: suffix of the folders' names, which tells kinds of results apart; "" for a fit.
        optional: files of former results that are removed unless the new ones have them.
        replaced: subfolders that are replaced as wholes.
        merged: subfolders of images where only images that kgs wrote are removed.
    """

    out: Path
    kind: str = ""
    optional: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()
    merged: tuple[str, ...] = ()

    @property
    def unfinished(self) -> Path:
        """Where new results are written."""
        return self.out / f"unfinished{self.kind}"

    @property
    def finished(self) -> Path:
        """Where whole results wait until they are moved to `out`."""
        return self.out / f"finished{self.kind}"

    @property
    def is_waiting(self) -> bool:
        """Whether whole results wait, none of which has been moved yet."""
        try:
            return all((self.finished / name).exists() for name in self._listed())
        except DataError:
            return False

    def start(self) -> None:
        """Make an empty folder for new results."""
        make_own_folder(self.unfinished)

    def seal(self) -> None:
        """Declare the new results whole."""
        write_json(self.unfinished / _LIST, {"files": _files(self.unfinished)})
        shutil.rmtree(self.finished, ignore_errors=True)
        os.replace(self.unfinished, self.finished)

    def complete(self) -> None:
        """Move whole results to their places; does nothing if there are none."""
        if not (is_own(self.finished) and (self.finished / _LIST).exists()):
            return
        names = self._listed()  # includes files that were moved before a kill
        for name in set(self.optional) - set(names):
            (self.out / name).unlink(missing_ok=True)
        for name in self.replaced:
            if (self.finished / name).is_dir():
                shutil.rmtree(self.out / name, ignore_errors=True)
                os.replace(self.finished / name, self.out / name)
        for folder in self.merged:
            (self.out / folder).mkdir(exist_ok=True)
            remove_own_images(self.out / folder, {PurePosixPath(name).name for name in names if "/" in name})
        for name in _files(self.finished):
            os.replace(self.finished / name, self.out / name)
        shutil.rmtree(self.finished)

    def discard(self) -> None:
        """Remove whole results that wait."""
        shutil.rmtree(self.finished, ignore_errors=True)

    def _listed(self) -> list[str]:
        return [str(name) for name in read_json(self.finished / _LIST).get("files", [])]


def _files(folder: Path) -> list[str]:
    """The files of a folder and its subfolders, without those that a kill left half written."""
    whole = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix != ".partial"]
    return [path.relative_to(folder).as_posix() for path in whole if path.name[0] != "." and path.name != _LIST]
