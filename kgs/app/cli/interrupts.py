"""Ctrl-C, while modules are imported and after that."""

import os
import signal
from contextlib import suppress
from types import FrameType


def leave_at_once() -> None:
    """Let Ctrl-C end the process at once: no work is lost yet, and an import could swallow the exception."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with suppress(ValueError):  # only the main thread may set it
            signal.signal(signal.SIGINT, _leave)


def interrupt_as_usual() -> None:
    """Let Ctrl-C raise KeyboardInterrupt again."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _leave(number: int, _: FrameType | None) -> None:
    os._exit(128 + number)
