"""Locks that end with the process that holds them."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from kgs._support.errors import DataError


@contextmanager
def held(path: Path, wait: bool = False, unknown: bool = True) -> Iterator[bool]:
    """Lock a file, created if missing, until the block or the process ends.

    Yields False if another one holds the lock, and `unknown` on a file system without locks; with `wait` the block
    begins when it is free.
    """
    with open(path, "ab") as file:
        ours = True
        try:
            if sys.platform == "win32":
                import msvcrt

                file.seek(2**30)  # beyond its end, because Windows forbids to read locked bytes
                msvcrt.locking(file.fileno(), msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            ours = False
        except OSError:
            ours = unknown
        yield ours


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Keep other fits, and `kgs eval`, out of a folder until the block or the process ends.

    Raises:
        DataError: one of them is at work there.
    """
    with held(out / ".lock") as ours:
        if not ours:
            raise DataError(
                out,
                "",
                "no kgs at work on the fit in this folder",
                "one",
                advice="wait for it or choose another folder",
            )
        yield
