"""Finds the cameras of unposed photos. `pose` runs the parts: find, read, keypoints, match, map, gates, write.

The input is a folder of photos as a phone wrote them, the output a scene that kgs and other programs read. Two solvers
have to agree, and gates refuse cameras that cannot be trusted: see :mod:`kgs.sfm.gates`.
"""

from .pose import pose_photos

__all__ = ["pose_photos"]
