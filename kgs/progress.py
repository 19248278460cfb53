"""How functions that take a while show their progress: they are given a wrapper for their loop."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

Stage = Callable[[Sequence[Any], str, str], Iterable[Any]]  # items, what is done to them, the word for one of them


def silent(items: Sequence[Any], title: str, unit: str) -> Iterable[Any]:
    """The items, without a word."""
    return items
