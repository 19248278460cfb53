"""What a solver of cameras may have found, without solving anything."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import cv2
import numpy as np

from kgs.app.sfm.map import Cameras


def solved(
    names: Iterable[str],
    points: Mapping[str, int] | None = None,
    turned: Mapping[str, float] | None = None,
    focals: Mapping[str, float] | None = None,
    rise: float = 0.1,
) -> Cameras:
    """Cameras in a row that look along z, each with 90 points and a focal length of 800 pixels unless given otherwise.

    Args:
        names: of the photos that were registered.
        points: how many each sees.
        turned: about y, in degrees.
        focals: in pixels; also of photos that were not registered.
        rise: by what share squared errors grow if focal lengths are a quarter off.
    """
    names = list(names)
    turns = dict.fromkeys(names, 0.0) | dict(turned or {})
    rotations = {name: cv2.Rodrigues(np.array([0.0, np.radians(turns[name]), 0.0]))[0] for name in names}
    centers = {name: np.array([float(i), 0.0, 0.0]) for i, name in enumerate(names)}
    counts = dict.fromkeys(names, 90) | dict(points or {})
    lenses = dict.fromkeys(names, 800.0) | dict(focals or {})
    return Cameras(lenses, rotations, centers, counts, None, rise)
