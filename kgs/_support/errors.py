"""Errors: a wrong argument, a bad file, and a fit whose numbers are no longer finite; and warnings."""

import inspect
import warnings
from collections.abc import Sequence
from os import PathLike

_END = 160  # letters of each end of a long text


def printable(text: object) -> str:
    """Text as one line of a message: control characters, as file names may have, are escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


def listed(names: Sequence[object], max_names: int = 3) -> str:
    """The first names of several, printable, and how many more there are."""
    more = len(names) - max_names
    text = ", ".join(printable(name) for name in names[:max_names])
    return f"{text} and {more} more" if more > 0 else text


def cause_of(error: BaseException) -> str:
    """In one line what an error was first caused by; of a long text, as compilers write it, the two ends."""
    while error.__cause__ is not None:
        error = error.__cause__
    text = printable(" ".join(f"{type(error).__name__}: {error}".split()))
    return text if len(text) <= 2 * _END else f"{text[:_END]} ... {text[-_END:]}"


def quantity(number: int, noun: str) -> str:
    """A number and a noun, whose plural has an s: as "1 photo" and "2 photos"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line that called kgs: the innermost one that is neither in kgs nor in torch."""
    names = [call.frame.f_globals.get("__name__", "") for call in inspect.stack(context=0)]
    outside = [not f"{name}.".startswith(("torch.", "kgs.")) for name in [*names, ""]]
    warnings.warn(message, category, stacklevel=outside.index(True) + 1)


class ArgumentError(ValueError):
    """An argument has another value than expected; the message begins with its name and a colon.

    kgs raises it wherever it checks a value, and nothing else raises it. The class, not the text, so tells a mistake of
    the caller from one in the code: torch, NumPy and Python raise plain ValueErrors. A value of a wrong type is a
    TypeError, which no command line can bring about. `kgs.drop` and `kgs.reference`, which stand alone, raise plain
    ValueErrors too; commands check what they pass to them.
    """


class DataError(Exception):
    """A file or folder has other contents than expected.

    Args:
        path: the file or folder at fault.
        field: the part of it that is wrong (a key, a property, a line), or "" for the file as a whole.
        reason: what was expected, and what the file holds.
    """

    def __init__(self, path: str | PathLike[str], field: str, reason: str) -> None:
        super().__init__(path, field, reason)
        self.path = path
        self.field = field
        self.reason = reason

    def __str__(self) -> str:
        where = f"{self.path}: {self.field}" if self.field else f"{self.path}"
        return f"{printable(where)}: {self.reason}"


class PhotosRefused(DataError):
    """The cameras of photos cannot be found, or cannot be trusted; the reason says what to photograph next."""


class TrainingDiverged(RuntimeError):
    """A loss, gradient or parameter is no longer finite; raised before it can reach the optimiser's state."""
