"""The module pycolmap, with a silent log. Its import takes over SIGTERM, whose former handler is put back.

Kept apart, because it is of an extra, and because folders are looked at before it is loaded.
"""

import signal
import threading

_before = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402

if threading.current_thread() is threading.main_thread() and _before is not None:
    signal.signal(signal.SIGTERM, _before)
pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)

__all__ = ["pycolmap"]
