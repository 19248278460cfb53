"""Lines and progress bars on the console. A closed pipe never aborts a fit."""

import logging
import os
import shlex
import sys
import time
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from kgs._support.errors import printable

_FIRST_LINE = (
    30.0  # seconds after which a stage has a line, where there is no terminal; the next one after twice as many
)
VIEWER = "open {} in a viewer of 3DGS files, for example superspl.at/editor in a browser"  # a step to suggest


_is_quiet = False


@contextmanager
def quiet(is_quiet: bool) -> Iterator[None]:
    """Leave out in this block, if asked to, what is said on stdout, and progress; errors and warnings stay."""
    global _is_quiet
    before = _is_quiet
    _is_quiet = is_quiet
    try:
        yield
    finally:
        _is_quiet = before


def say(line: str, file: TextIO | None = None) -> None:
    """Print one or more lines, on stdout unless told otherwise, and flush them.

    Control characters, and letters that the stream cannot encode, become escapes. A closed pipe is no error.
    """
    if file is None and _is_quiet:
        return
    stream = sys.stdout if file is None else file
    line = "\n".join(map(printable, line.split("\n")))
    with suppress(OSError, ValueError, AttributeError):  # closed by its reader or by the program, or None
        encoding = stream.encoding or "utf-8"
        print(line.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


def say_next(first: str, *others: str) -> None:
    """Suggest next steps to the user; off a terminal the first one alone."""
    say("\n  ".join(["next:", first, *others]) if others and is_terminal() else f"next: {first}")


def say_on_terminal(line: str) -> None:
    """As :func:`say`, but only to somebody who waits for what comes next."""
    if is_terminal():
        say(line)


def is_terminal() -> bool:
    """Whether somebody reads stdout as it is written."""
    with suppress(OSError, ValueError, AttributeError):  # closed, or None
        return sys.stdout.isatty()
    return False


def open_in_browser(page: Path) -> None:
    """Open a page in the user's browser; a line says so where there is none."""
    if not webbrowser.open(page.resolve().as_uri()):
        say(f"kgs: no browser was found: open {printable(page)} yourself", sys.stderr)


@contextmanager
def log_shown() -> Iterator[None]:
    """Print what the library's log says of its progress, a line each, on stderr."""
    log = logging.getLogger("kgs")
    level = log.level
    handler = _Lines()
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)


class _Lines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        if not _is_quiet:
            say(f"kgs: {record.getMessage()}", sys.stderr)


def as_line(*words: object) -> str:
    """Words quoted for a shell, on one line."""
    return " ".join(_quoted(_argument(word)) for word in words)


def _argument(word: object) -> str:
    """The word; a path that begins with a dash is no option."""
    return f"./{word}" if isinstance(word, Path) and str(word).startswith("-") else str(word)


def _quoted(word: str) -> str:
    if word.isprintable():
        return shlex.quote(word)
    escaped = word.replace("\\", "\\\\").replace("'", "\\'")
    return f"$'{''.join(map(_escaped, escaped))}'"


def _escaped(letter: str) -> str:
    """As bash reads it in quotes: other than ASCII by its bytes."""
    if letter.isprintable() or letter.isascii():
        return printable(letter)
    return "".join(f"\\x{byte:02x}" for byte in os.fsencode(letter))


@contextmanager
def progress(total: int, title: str, done: int = 0, unit: str = "step") -> Iterator[Callable[..., None]]:
    """Show the progress of a stage of `total` units on stderr: a bar on a terminal, else a few lines.

    Both have the time that is left. Off a terminal, in a file or a pipe, lines come after half a minute, 1, 2, 4, ...
    minutes. The first unit, in which kernels may be compiled, tells nothing about the time of the others.

    Args:
        total: number of units; with 0 nothing is shown.
        title: name of the stage.
        done: number of units that are already done.
        unit: name of a unit; its plural has an s.

    Yields:
        `advance(note="")`, to be called after each unit. The note is shown behind the figures.
    """
    bar: Any = None
    if _is_quiet:
        yield lambda note="": None
        return
    with suppress(OSError, ValueError, AttributeError, ImportError):  # no tqdm, or a stderr that is closed
        if sys.stderr.isatty():
            from tqdm import tqdm

            bar = tqdm(total=total, initial=done, desc=title, unit=unit, mininterval=0.5, file=sys.stderr)
    begin = time.monotonic()
    due = _FIRST_LINE
    first = 0.0  # seconds of the first unit
    units = 0

    def advance(note: str = "") -> None:
        nonlocal done, due, first, units
        done += 1
        units += 1
        if bar is not None:
            with suppress(OSError, ValueError):
                bar.set_postfix_str(note, refresh=False)
                bar.update()
            return
        seconds = time.monotonic() - begin
        if units == 1:
            first = seconds
        if seconds >= due and units > 1 and done < total:
            due = 2 * seconds
            left = (seconds - first) / (units - 1) * (total - done)
            parts = [f"{title}: {done} of {total} {unit}s"]
            if left > 1:
                parts.append(f"{left:.0f} s left" if left < 100 else f"{left / 60:.1f} minutes left")
            say(", ".join([*parts, *([note] if note else [])]), sys.stderr)

    try:
        yield advance
    finally:
        if bar is not None:
            with suppress(OSError, ValueError):
                bar.close()


def each(items: Sequence[Any], title: str, unit: str) -> Iterator[Any]:
    """Iterate over the items with a progress bar."""
    with progress(len(items), title, unit=unit) as advance:
        for item in items:
            yield item
            advance()
