"""What a fit says while it works: lines, and how far each stage is. Nobody who stops listening can end the work."""

import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from kgs.errors import printable

VIEWER = "open {} in a viewer of 3DGS files, for example superspl.at/editor in a browser"  # a next step
Stage = Callable[[Sequence[Any], str, str], Iterable[Any]]  # what `each` and `silent` are


def say(line: str, file: TextIO | None = None) -> None:
    """Print one or more lines, on stdout unless told otherwise, and flush them.

    Control characters, and letters that the terminal does not have, become escapes. Writing to a closed pipe does
    nothing.
    """
    stream = sys.stdout if file is None else file
    line = "\n".join(map(printable, line.split("\n")))
    with suppress(OSError, ValueError, AttributeError):  # closed by the reader, closed by the program, none at all
        encoding = stream.encoding or "utf-8"
        print(line.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


def say_next(*steps: str) -> None:
    """Say what the user may do now."""
    say("\n  ".join(["next:", *steps]))


def as_line(*words: object) -> str:
    """Words as one types them in a shell, on one line."""
    return " ".join(_quoted(str(word)) for word in words)


def _quoted(word: str) -> str:
    if word.isprintable():
        return shlex.quote(word)
    escaped = word.replace("\\", "\\\\").replace("'", "\\'")
    return f"$'{printable(escaped)}'"


@contextmanager
def progress(total: int, title: str, done: int = 0, unit: str = "step") -> Iterator[Callable[..., None]]:
    """Show on stderr how far a stage of `total` units is: a bar on a terminal, else a line for every tenth.

    Yields `advance(note="")`, for one more unit that is done; the note stands behind the figures. `done` units were
    done before. With a total of 0 nothing is shown.
    """
    bar: Any = None
    with suppress(OSError, ValueError, AttributeError, ImportError):  # no tqdm, or a stderr that is closed
        if sys.stderr.isatty():
            from tqdm import tqdm

            bar = tqdm(total=total, initial=done, desc=title, unit=unit, mininterval=0.5, file=sys.stderr)

    def advance(note: str = "") -> None:
        nonlocal done
        done += 1
        if bar is not None:
            with suppress(OSError, ValueError):
                bar.set_postfix_str(note, refresh=False)
                bar.update()
        elif done * 10 // total > (done - 1) * 10 // total:
            say(f"{title}: {done} of {total} {unit}s{', ' * bool(note)}{note}", sys.stderr)

    try:
        yield advance
    finally:
        if bar is not None:
            with suppress(OSError, ValueError):
                bar.close()


def each(items: Sequence[Any], title: str, unit: str) -> Iterator[Any]:
    """The items; each that is done moves the stage on."""
    with progress(len(items), title, unit=unit) as advance:
        for item in items:
            yield item
            advance()


def silent(items: Sequence[Any], title: str, unit: str) -> Iterable[Any]:
    """The items; nothing is shown."""
    return items
