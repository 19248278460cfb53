"""Scenes as posed images: from disk in the layouts of LLFF, COLMAP, Blender and nerfstudio, or made on the spot."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .load import load_scene
    from .scene import Scene, Views
    from .synthetic import synthetic_scene

__all__ = ["Scene", "Views", "load_scene", "synthetic_scene"]

_HOMES = {"Scene": "scene", "Views": "scene", "load_scene": "load", "synthetic_scene": "synthetic"}


def __getattr__(name: str) -> Any:
    """The names are loaded when they are asked for, and torch with them: folders are looked at without it."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)
