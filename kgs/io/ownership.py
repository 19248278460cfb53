"""Tells files of kgs from the user's: each file that kgs writes contains the mark `made by kgs`, as its format allows.

PNG has it as Software text, PLY as a comment, JSON under "generator", HTML and glTF as generator, WebM in a void
element, MP4 in a free box, checkpoints in their metadata. Nothing else is ever overwritten or removed.
"""

import shutil
from collections.abc import Collection
from pathlib import Path

from kgs.json_files import GENERATOR

MADE_BY = GENERATOR
MARK = MADE_BY.encode()
_FOLDER_MARK = ".kgs"  # an empty file in a temporary folder
_HEAD, _TAIL = 2**20, 2**10  # bytes that are searched: the mark is at the end of films, else in the header


def is_own(path: Path) -> bool:
    """Whether kgs wrote this file or made this folder; an empty folder counts."""
    if path.is_dir():
        return (path / _FOLDER_MARK).is_file() or not any(path.iterdir())
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        if MARK in file.read(_HEAD):
            return True
        file.seek(max(0, path.stat().st_size - _TAIL))
        return MARK in file.read()


def make_own_folder(path: Path) -> None:
    """An empty folder that `is_own` recognises, in place of a former one."""
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir()
    (path / _FOLDER_MARK).touch()


def remove_own_images(folder: Path, keep: Collection[str]) -> None:
    """Remove the PNGs of a former run, except those named in `keep`; the user's stay."""
    for path in folder.glob("*.png"):
        if path.name not in keep and is_own(path):
            path.unlink()
