"""Finds the cameras of unposed photos. `pose` runs the parts: find, read, keypoints, match, map, gates, write.

The input is a folder of photos as a phone wrote them, the output a scene that kgs and other programs read. Two solvers
have to agree, and gates refuse cameras that cannot be trusted: see :mod:`kgs.sfm.gates`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .pose import pose_photos

__all__ = ["pose_photos"]


def __getattr__(name: str) -> Any:
    """`pose_photos` is loaded when it is asked for, and torch with it: folders are looked at without it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .pose import pose_photos

    return pose_photos
