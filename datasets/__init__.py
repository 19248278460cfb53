"""Scenes as posed images: from disk in the layouts of LLFF, COLMAP, Blender and nerfstudio, or made on the spot."""

from kgs._support.lazy import public_names

# folders are looked at without torch
__getattr__, __dir__, __all__ = public_names(__name__, __file__)
