"""Cameras of unposed photos: read, keypoints, match, map, gates, write, in this order, run by `pose`.

Photos as a phone wrote them go in; a scene that kgs and other programs read comes out. Two solvers have to agree, and
gates refuse cameras that cannot be believed: see :mod:`kgs.sfm.gates`.
"""

from .pose import pose_photos

__all__ = ["pose_photos"]
