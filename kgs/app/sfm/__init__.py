"""Finds the cameras of unposed photos. `pose` runs the parts: find, read, match, map, accept, write.

The input is a folder of photos as a phone wrote them, the output a scene that kgs and other programs read. Two solvers
have to agree, and cameras that cannot be trusted are refused: see :mod:`kgs.app.sfm.accept`.
"""

from kgs._support.lazy import public_names

# folders are looked at without torch
__getattr__, __dir__, __all__ = public_names(__name__, __file__)
