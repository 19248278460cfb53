"""Progress of long loops: functions wrap their loops in a `ProgressBar` of the caller.

>>> from tqdm import tqdm
>>> bar = lambda items, title, unit: tqdm(items, desc=title, unit=f" {unit}")
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

ProgressBar = Callable[[Sequence[Any], str, str], Iterable[Any]]  # items, title, name of one item: the same items


def silent(items: Sequence[Any], title: str, unit: str) -> Iterable[Any]:
    """The items, without any output."""
    return items
