"""Scenes as posed images: from disk in the layouts of LLFF, COLMAP, Blender and nerfstudio, or made on the spot."""

from typing import TYPE_CHECKING

from kgs._support.lazy import lazy_names

if TYPE_CHECKING:
    from .load import load_scene
    from .scene import Scene, Views
    from .synthetic import synthetic_scene

__all__ = ["Scene", "Views", "load_scene", "synthetic_scene"]

# folders are looked at without torch
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "kgs.datasets.scene": ("Scene", "Views"),
        "kgs.datasets.load": ("load_scene",),
        "kgs.datasets.synthetic": ("synthetic_scene",),
    },
)
