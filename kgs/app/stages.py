"""Names the stages of `kgs fit` as they begin."""

from collections.abc import Callable


class Stages:
    """Says "3 of 5: fit" when that stage begins.

    Args:
        say: called with the line.
        unposed: whether cameras are found first.
    """

    def __init__(self, say: Callable[[str], None], unposed: bool = False) -> None:
        self._say = say
        self._names = [*(["cameras"] if unposed else []), "initial points", "fit", "film", "page"]

    def begin(self, name: str) -> None:
        """Say that a stage begins: "cameras", "initial points", "fit", "film" or "page"."""
        self._say(f"{self._names.index(name) + 1} of {len(self._names)}: {name}")
