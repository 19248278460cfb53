"""What a fit says while it works: lines, and how far each stage is. Nobody who stops listening can end the work."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, TextIO

__all__ = ["Stage", "each", "progress", "say", "silent"]

Stage = Callable[[Sequence[Any], str, str], Iterable[Any]]  # what `each` and `silent` are

_LINES = 10  # per stage, where there is no terminal


def say(line: str, file: TextIO | None = None) -> None:
    """Print a line, on stdout unless told otherwise, and flush it.

    Letters that the terminal does not have become escapes. Where the reader has gone (a closed pipe) nothing happens.
    """
    stream = sys.stdout if file is None else file
    with suppress(OSError, ValueError, AttributeError):  # closed by the reader, closed by the program, none at all
        encoding = stream.encoding or "utf-8"
        print(line.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


@contextmanager
def progress(total: int, title: str, done: int = 0, unit: str = "step") -> Iterator[Callable[..., None]]:
    """Show on stderr how far a stage is: a bar on a terminal, else a line for every tenth.

    Args:
        total: how many units the stage has; with 0 nothing is shown.
        title: the name of the stage.
        done: how many units were done before.
        unit: what is counted.

    Yields:
        `advance(note="")`: one more unit is done; the note stands behind the figures.

    Examples:
        >>> with progress(3, "depth maps", unit="view") as advance:
        ...     for _ in range(3):
        ...         advance()
    """
    bar = _bar(total, title, done, unit)

    def advance(note: str = "") -> None:
        nonlocal done
        done += 1
        if bar is not None:
            with suppress(OSError, ValueError):
                bar.set_postfix_str(note, refresh=False)
                bar.update()
        elif done * _LINES // total > (done - 1) * _LINES // total:
            say(f"{title}: {done} of {total} {unit}s{', ' * bool(note)}{note}", sys.stderr)

    try:
        yield advance
    finally:
        if bar is not None:
            with suppress(OSError, ValueError):
                bar.close()


def each(items: Sequence[Any], title: str, unit: str) -> Iterator[Any]:
    """The items, with :func:`progress` behind each that is done."""
    with progress(len(items), title, unit=unit) as advance:
        for item in items:
            yield item
            advance()


def silent(items: Sequence[Any], title: str, unit: str) -> Iterable[Any]:
    """Like :func:`each`, and shows nothing."""
    return items


def _bar(total: int, title: str, done: int, unit: str) -> Any:
    """A bar where stderr is a terminal and tqdm is there, else None."""
    with suppress(OSError, ValueError, AttributeError, ImportError):
        if sys.stderr.isatty():
            from tqdm import tqdm

            return tqdm(total=total, initial=done, desc=title, unit=unit, mininterval=0.5, file=sys.stderr)
    return None
