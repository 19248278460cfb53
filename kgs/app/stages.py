"""Names the stages of `kgs fit` as they begin."""

from collections.abc import Callable


class Stages:
    """Says "3 of 5: fit" when that stage begins.

    Args:
        say: called with the line.
        unposed: whether cameras are found first.
        measured: whether a photo is measured before the fit.
    """

    def __init__(self, say: Callable[[str], None], unposed: bool = False, measured: bool = False) -> None:
        self._say = say
        before = [name for name, is_done in (("cameras", unposed), ("measurement", measured)) if is_done]
        self._names = [*before, "initial points", "fit", "film", "page"]

    def begin(self, name: str) -> None:
        """Say that a stage begins: "cameras", "measurement", "initial points", "fit", "film" or "page"."""
        self._say(f"{self._names.index(name) + 1} of {len(self._names)}: {name}")
