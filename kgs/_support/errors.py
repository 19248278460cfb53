"""Errors: a wrong argument, a bad file, and a fit whose numbers are no longer finite; and warnings."""

import inspect
import warnings
from collections.abc import Sequence
from os import PathLike

_END = 160  # letters of each end of a long text
_SHOWN = 60  # letters of a value


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


def quoted(value: object) -> str:
    """The value of a user or of a file as an error shows it: a text in quotes, others plainly; cut."""
    return _cut(repr(value)) if isinstance(value, str | bytes) else _shown(value)


def sentence(where: str, expected: str, got: str, advice: str) -> str:
    """What an error says, "where: expected this, got that: do so". Only an advice may have several lines."""
    fact = printable(f"{where}: expected {expected}{f', got {got}' if got else ''}")
    return fact + "\n".join(map(printable, f": {advice}".split("\n"))) if advice else fact


def _cut(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


def _shown(got: object) -> str:
    return got if isinstance(got, str) else _cut(" ".join(str(got).split()))


class ArgumentError(ValueError):
    """An argument has another value than expected: "steps: expected at least 1, got 0".

    kgs raises it wherever it checks a value, and nothing else raises it. The class, not the text, so tells a mistake of
    the caller from one in the code: torch, NumPy and Python raise plain ValueErrors. A value of a wrong type is a
    TypeError, which no command line can bring about. `kgs.drop` and `kgs.reference`, which stand alone, raise plain
    ValueErrors too; commands check what they pass to them.

    Args:
        name: of the argument, or of several, as "near, far".
        expected: what the argument has to be.
        got: what it is, or "" where that says nothing. Words are shown as they are, other values as text of at most 60
            letters; so is the attribute.
        advice: why that is so, or what to do about it.
    """

    def __init__(self, name: str, expected: str, got: object = "", *, advice: str = "") -> None:
        self.name = name
        self.expected = expected
        self.got = _shown(got)
        self.advice = advice
        super().__init__(name, expected, self.got)

    def __str__(self) -> str:
        return sentence(self.name, self.expected, self.got, self.advice)

    def about(self, path: str | PathLike[str], key: str | None = None) -> "DataError":
        """The same about a file, in which the argument is an entry; `key` names it otherwise."""
        return DataError(path, self.name if key is None else key, self.expected, self.got, advice=self.advice)


class DataError(Exception):
    """A file or folder has other contents than expected: "config.json: fit: expected an object, got none".

    Args:
        path: the file or folder at fault.
        key: the part of it that is wrong (an entry, a property, a line), or "" for the file as a whole.
        expected: what that has to be.
        got: what it is, or "" where that says nothing; as of :class:`ArgumentError`.
        advice: why that is so, or what to do about it.
    """

    def __init__(
        self, path: str | PathLike[str], key: str, expected: str, got: object = "", *, advice: str = ""
    ) -> None:
        self.path = path
        self.key = key
        self.expected = expected
        self.got = _shown(got)
        self.advice = advice
        super().__init__(path, key, expected, self.got)

    def __str__(self) -> str:
        where = f"{self.path}: {self.key}" if self.key else f"{self.path}"
        return sentence(where, self.expected, self.got, self.advice)


class PhotosRefused(DataError):
    """The cameras of photos cannot be found, or cannot be trusted; the advice says what to photograph next."""


class TrainingDiverged(RuntimeError):
    """A loss, gradient or parameter is no longer finite: on a CPU before it reaches a parameter, see `Trainer.fit`."""
