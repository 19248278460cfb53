"""Whether photos fit together: a splat of photos that contradict each other does not show even their outlines.

What is fine or seen from one side is hard to fit, and says nothing. So photo and render are compared in squares of a
24th of the longer side, and only where another training view shows the same surface. Of thirteen sets without a mistake
the worst had 34.5 dB in the mean of its photos, and its worst photo 29.9; of two desks taken for one the mean was 31.2,
and the worst photo 25.4 (docs/results/cameras).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from kgs._support.errors import listed
from kgs.datasets.scene import Views
from kgs.geometry.cameras import resized

from .coverage import views_that_show

MIN_PSNR = 28.0  # of each photo, in dB
MIN_MEAN = 32.5  # of all photos
_SQUARES = 24  # along the longer side
_MAX_PSNR = 100.0  # stands for an infinite one


@torch.no_grad()
def outline_levels(views: Views, images: Iterable[Tensor], depths: Sequence[Tensor]) -> dict[str, float]:
    """The PSNR in dB of each training view in large squares, where another view shows the same surface.

    Views of which no square is shown by another view have none.

    Args:
        views: the training views.
        images: their renders, each `(1, 3, H, W)`.
        depths: the median depths of these, each `(H, W)` on the CPU, 0 where there is nothing.
    """
    levels = {}
    for i, image in enumerate(images):
        shown, photo, _ = views.compared(i, image[0])
        side = max(1, max(photo.shape[-2:]) // _SQUARES)
        errors = (F.avg_pool2d(shown, side) - F.avg_pool2d(photo, side)).square().mean(0).cpu()
        size = errors.shape[0], errors.shape[1]
        middles = depths[i][side // 2 :: side, side // 2 :: side][: size[0], : size[1]]
        camera = resized(views.camera(i), 1 / side, size)
        is_seen = views_that_show(middles, camera, depths, views.cameras) > 1  # by itself, and by another
        if is_seen.any():
            error = float(errors[is_seen].mean())
            levels[views.names[i]] = min(_MAX_PSNR, -10 * math.log10(error)) if error > 0 else _MAX_PSNR
    return levels


def doubt(levels: Mapping[str, Any]) -> str:
    """A sentence on photos that do not fit together, by their :func:`outline_levels`, or ""."""
    if not levels:
        return ""
    names = [name for name in levels if levels[name] < MIN_PSNR]
    causes = "something moved between the photos, the light changed, or a camera is wrong"
    if fmean(levels.values()) < MIN_MEAN:
        names = names or sorted(levels, key=lambda name: levels[name])[:1]
        return f"The photos contradict each other: {causes}. The splat shows these worst: {listed(names, 6)}."
    return f"The splat does not show even the outlines of {listed(names, 6)}: {causes}." if names else ""
