"""Depths from depth maps of the photos themselves, as networks and sensors make them, where no two photos agree.

Such a map knows depth, or inverse depth, up to scale and shift. Both are fitted to the pixels on whose depth two photos
agree: the line with the least median of errors, then least squares over the pixels near that line.

Source: Rousseeuw, "Least Median of Squares Regression" (JASA 1984).
"""

import math
from typing import NamedTuple

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.errors import listed, warn
from kgs.datasets.scene import Views

from .agreement import before_surfaces
from .plane_sweep import DepthMap

MAX_ERROR = 0.1  # of depth, relative, in the median: farther off, points are of no surface near them
MIN_PIXELS = 100  # that photos agree on
# A map also has to be better than one depth for all pixels: in a shallow scene that is right within 10 %, too.
MAX_OF_CONSTANT = 0.5  # of the error of that depth
LINES = 500  # through two pixels each; a third of wrong pixels leaves half of them
SAMPLE = 1000  # pixels that each line is compared with
NEAR = 3.0  # times the median error, within which pixels count in the least squares
EXACT = 1e-4  # error up to which all pixels do


class MapDepths(NamedTuple):
    """Depths from depth maps."""

    depths: list[Tensor]  # of each view, `(H, W)` float64; 0 where there is none
    errors: list[float]  # of each map that is used, the median relative error of depth where photos agree


def map_depths(
    views: Views, cameras: PinholeCamera, maps: list[DepthMap], agreed: list[Tensor], nearest: float, farthest: float
) -> MapDepths:
    """The depths by `views.depths` of usable pixels on which no two views agree, from `nearest` to `farthest`.

    There are none before a surface that other views agree on. Maps that do not fit are left out, with a warning.

    Args:
        views: whose depth maps have any scale and shift.
        cameras: theirs, float64 on the CPU.
        maps: the depths from the plane sweep.
        agreed: where these count, `(H, W)` for each view.
        nearest: the least depth.
        farthest: the largest depth, also of pixels that a map is fitted to.
    """
    found = MapDepths([torch.zeros_like(depth_map.depths, dtype=torch.float64) for depth_map in maps], [])
    if views.depths is None:
        return found
    usable = views.usable
    faults = []
    for view, values in enumerate(views.depths.cpu().double()):
        if not values.any():
            continue  # there is no map of this photo
        pixels = agreed[view] & (values != 0) & (maps[view].depths < farthest)
        if (count := int(pixels.sum())) < MIN_PIXELS:
            faults.append(f"{views.names[view]} (photos agree on {count} of its pixels)")
            continue
        depths, error, of_constant = fitted(values, maps[view].depths[pixels].double(), pixels)
        if not error <= min(MAX_ERROR, max(MAX_OF_CONSTANT * of_constant, EXACT)):
            faults.append(f"{views.names[view]} ({error:.0%} off, one depth for all {of_constant:.0%})")
            continue
        depths[agreed[view] | (values == 0) | (depths < nearest) | (depths > farthest)] = 0.0
        if usable is not None:
            depths[~usable[view].cpu()] = 0.0
        depths[before_surfaces(cameras, maps, agreed, depths, view)] = 0.0
        found.depths[view] = depths
        found.errors.append(error)
    if faults:
        warn(f"depth maps that do not fit the depths on which photos agree are left out: {listed(faults)}")
    return found


def fitted(values: Tensor, depths: Tensor, pixels: Tensor) -> tuple[Tensor, float, float]:
    """The depths `(H, W)` of a map's values, their median relative error, and that of one depth for all pixels.

    The values are taken as depths or as inverse depths, by what fits better; depths <= 0 have no meaning.

    Args:
        values: of the map, `(H, W)` float64.
        depths: the true ones of P pixels, `(P,)`.
        pixels: which these are, bool `(H, W)`.
    """
    known = values[pixels]
    line, error = _line(known, depths)
    inverse_line, inverse_error = _line(known, 1 / depths)
    is_inverse = inverse_error < error
    slope, shift = inverse_line if is_inverse else line
    lined = slope * values + shift
    _, constant_error = _line(torch.zeros_like(known), 1 / depths if is_inverse else depths)
    return 1 / lined if is_inverse else lined, min(error, inverse_error), constant_error


def _line(x: Tensor, y: Tensor) -> tuple[Tensor, float]:
    """Slope and shift `(2,)` of the line from x to y > 0, both `(P,)`, that most pixels lie near; its median error."""
    generator = torch.Generator().manual_seed(0)
    first, second = torch.randint(len(x), (2, LINES), generator=generator)
    rise = y[second] - y[first]
    run = x[second] - x[first]
    slopes = torch.where(run == 0, 0.0, rise / run)
    shifts = y[first] - slopes * x[first]
    some = torch.randperm(len(x), generator=generator)[:SAMPLE]
    errors = _errors(slopes[:, None] * x[some] + shifts[:, None], y[some]).median(1).values
    best = int(errors.argmin())
    is_near = _errors(slopes[best] * x + shifts[best], y) <= max(NEAR * float(errors[best]), EXACT)
    x_near = x[is_near]
    y_near = y[is_near]
    weighted = torch.stack([x_near, torch.ones_like(x_near)], 1) / y_near[:, None]  # errors are relative
    line = torch.linalg.lstsq(weighted, torch.ones_like(y_near)[:, None], driver="gelsd").solution[:, 0]
    return line, math.expm1(float(_errors(line[0] * x + line[1], y).median()))


def _errors(found: Tensor, true: Tensor) -> Tensor:
    """The error of each number above 0 as a logarithm, the same for inverse numbers; infinite for others."""
    return (found.clamp_min(0.0) / true).log().abs()
