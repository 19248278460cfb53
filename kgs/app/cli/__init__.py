"""The command `kgs`: from the words of a command line to an exit code.

Nothing heavy is imported here: neither torch, NumPy and OpenCV, nor tyro. A command is found by its name, then tyro
reads its options and input paths are looked for, and only then torch is loaded, which takes seconds.
"""

import atexit
import os
import sys
import warnings
from contextlib import suppress

from kgs._support.wait_policy import wait_passively

from .interrupts import leave_at_once


def main(arguments: list[str] | None = None) -> None:
    """Run one command and exit.

    Args:
        arguments: the words after `kgs`; those of this process unless given.

    Raises:
        SystemExit: always, with one of the codes that docs/command.md lists.
    """
    leave_at_once()
    wait_passively()
    from .run import exit_code

    _open_streams()
    with warnings.catch_warnings():
        code = exit_code(list(sys.argv[1:] if arguments is None else arguments))
    _flush_streams()
    sys.exit(code)


def command() -> None:
    """The command `kgs`: :func:`main`, and then end the process at once; to take torch apart costs 0.7 s."""
    try:
        main()
    except SystemExit as end:
        atexit._run_exitfuncs()
        os._exit(int(end.code or 0))


def _open_streams() -> None:
    """Open the standard streams that are closed: the next file to be opened would become one of them."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


def _flush_streams() -> None:
    """Write what is left. If nobody reads a stream, point it at the null device, or Python complains at exit."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, AttributeError):
            with suppress(OSError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
