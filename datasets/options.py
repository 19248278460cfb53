"""What `load_scene` may be asked for, whatever the scene. Loads neither NumPy nor torch, as the command wants it."""

import math
from numbers import Integral, Real
from typing import Any

from kgs._support.errors import ArgumentError, quoted

MASK_MODES = ("ignore", "transparent")  # of black in a mask: ignored pixels, or empty space
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


def held_out_between_ends(count: int, every: int) -> range:
    """Which of `count` photos between the ends of a row of cameras are held out: about every `every`-th, at least one.

    With more photos, no fewer are left to train on.
    """
    return range(min(every // 2, (count - 1) // 2), count, every)


def check_options(
    downscale: Any, hold_out: Any, background: str = "black", points: str = "none", mask_mode: str = "ignore"
) -> None:
    """Raise a ValueError for an argument of `load_scene` that no scene has a use for."""
    choices = (
        ("background", background, BACKGROUNDS),
        ("points", points, ("none", "model-points")),
        ("mask_mode", mask_mode, MASK_MODES),
    )
    for name, value, known in choices:
        if value not in known:
            raise ArgumentError(name, f"one of {list(known)}", quoted(value))
    real = isinstance(downscale, Real)
    whole = isinstance(hold_out, Integral) and not isinstance(hold_out, bool)
    if downscale is not None and not (real and 1 <= downscale < math.inf):
        raise ArgumentError("downscale", "None or a number of at least 1", quoted(downscale))
    if hold_out is not None and not (whole and (hold_out == 0 or hold_out >= 2)):
        raise ArgumentError("hold_out", "None, 0 or a whole number of at least 2", quoted(hold_out))
