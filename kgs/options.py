"""What the options of the commands have in common."""

from __future__ import annotations

from typing import Any

__all__ = ["alias"]


def alias(name: str) -> Any:
    """For an annotation: a second name for an option, as in `Annotated[Path, alias("-o")]`."""
    import tyro

    return tyro.conf.arg(aliases=(name,))
