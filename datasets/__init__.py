"""Scenes as posed images: from disk in the layouts of LLFF, COLMAP, Blender and nerfstudio, or made on the spot."""

from .load import load_scene
from .scene import Scene, Views
from .synthetic import synthetic_scene

__all__ = ["Scene", "Views", "load_scene", "synthetic_scene"]
