"""Finds the cameras of unposed photos. `pose` runs the parts: find, read, match, map, accept, write.

The input is a folder of photos as a phone wrote them, the output a scene that kgs and other programs read. Two solvers
have to agree, and cameras that cannot be trusted are refused: see :mod:`kgs.app.sfm.accept`.
"""

from typing import TYPE_CHECKING

from kgs._support.lazy import lazy_names

if TYPE_CHECKING:
    from .pose import pose_photos

__all__ = ["pose_photos"]


# folders are looked at without torch
__getattr__, __dir__ = lazy_names(__name__, {"kgs.app.sfm.pose": ("pose_photos",)})
