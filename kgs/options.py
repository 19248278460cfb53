"""What the options of the commands have in common."""

from __future__ import annotations

from typing import Any

__all__ = ["alias"]


def alias(name: str) -> Any:
    """A second name for an option, to annotate its type with."""
    import tyro

    return tyro.conf.arg(aliases=(name,))
