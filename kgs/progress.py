"""Progress of long loops: functions take a wrapper for their loop, which may display a bar."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

Stage = Callable[[Sequence[Any], str, str], Iterable[Any]]  # items, title, name of one item


def silent(items: Sequence[Any], title: str, unit: str) -> Iterable[Any]:
    """The items, without any output."""
    return items
