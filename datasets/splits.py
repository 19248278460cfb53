"""Splits views into training and test views, as published for sparse views (RegNeRF, FSGS, DropGaussian's release)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kgs._support.errors import ArgumentError, quoted

from .options import held_out_between_ends

TEST_EVERY = 8
BLENDER_TRAIN_FRAMES = (2, 16, 26, 55, 73, 76, 86, 93)


def split_by_name(
    names: Sequence[str], train_views: int | None = None, every: int = TEST_EVERY
) -> tuple[list[int], list[int]]:
    """Hold out each `every`-th name for testing (0: none) and choose training views evenly among the others.

    Names are sorted by code point ("img10" before "img2"), as the published splits were; the first one is a test view.
    Returns the positions in `names` of the training and of the test views, both in the order of the sorted names.
    """
    order = sorted(range(len(names)), key=lambda i: names[i])
    test = order[::every] if every else []
    pool = [index for position, index in enumerate(order) if not every or position % every]
    return [pool[i] for i in select_evenly(len(pool), train_views)], test


def split_between_ends(
    names: Sequence[str], centers: NDArray[np.float64], train_views: int | None = None, every: int = TEST_EVERY
) -> tuple[list[int], list[int]]:
    """As `split_by_name`, but hold out no photo at an end of the row of cameras: no other one shows what is beyond it.

    The ends are the two cameras that lie farthest apart along the main direction in which the centres `(V, 3)` spread.
    At least one photo is held out, of at least three.
    """
    spread = centers - centers.mean(axis=0)
    along = spread @ np.linalg.svd(spread, full_matrices=False)[2][0]
    inner = sorted({*range(len(names))} - {int(along.argmin()), int(along.argmax())}, key=lambda i: names[i])
    test = [inner[i] for i in held_out_between_ends(len(inner), every)]
    pool = sorted({*range(len(names))} - {*test}, key=lambda i: names[i])
    return [pool[i] for i in select_evenly(len(pool), train_views)], test


def select_evenly(count: int, train_views: int | None = None) -> list[int]:
    """Choose positions evenly among `count`, the first and the last included.

    The increasing positions are linspace(0, count - 1, train_views), rounded half to even: other roundings give other
    views. None takes all; ValueError for anything but an integer in [1, count].
    """
    if train_views is None:
        return list(range(count))
    if isinstance(train_views, bool) or not isinstance(train_views, int | np.integer) or not 1 <= train_views <= count:
        wanted = f"None or a whole number from 1 to {count}"
        raise ArgumentError("train_views", wanted, quoted(train_views))
    return [int(i) for i in np.round(np.linspace(0, count - 1, train_views))]
