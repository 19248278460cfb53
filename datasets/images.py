"""Photos as arrays: removing the lens's distortion, reducing, and the intrinsics that result."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from kgs._support.errors import ArgumentError

from .image_file import Image

Maps = tuple[Image, Image]
_LONGEST_REMAPPED = 2**15 - 1  # a limit of OpenCV
_MIN_WEIGHT = 1e-6  # of a pixel that has a colour of its own


@dataclass(frozen=True)
class Intrinsics:
    """A lens and the image size that its numbers refer to, all in pixels.

    Convention:
        The files' half-pixel convention: the first pixel's centre is at (0.5, 0.5), so that the numbers of a resized
        image are these times the ratio of the sizes. `matrix` has kgs's integer pixel centres.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  # in OpenCV's order, k1, k2, p1, p2, k3, k4, k5, k6; empty for a pinhole
    fisheye: bool = False  # the coefficients are those of `cv2.fisheye`, k1, k2, k3, k4

    def scaled(self, width: int, height: int) -> Self:
        """The same lens on an image of another size."""
        sx, sy = width / self.width, height / self.height
        fx, fy, cx, cy = self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)

    def same_aspect(self, width: int, height: int) -> bool:
        """Whether an image of this size can be a resized one, each side rounded to whole pixels."""
        return abs(width * self.height - height * self.width) <= max(self.width, self.height, width, height)

    def turned(self) -> Self:
        """The lens of a pinhole camera on an image that was turned by a quarter clockwise: x' = H - y, y' = x."""
        width, height = self.height, self.width
        return replace(self, width=width, height=height, fx=self.fy, fy=self.fx, cx=self.height - self.cy, cy=self.cx)

    def matrix(self) -> NDArray[np.float64]:
        """The 3x3 calibration matrix for integer pixel centres: the one place where half a pixel is subtracted."""
        return np.array([[self.fx, 0.0, self.cx - 0.5], [0.0, self.fy, self.cy - 0.5], [0.0, 0.0, 1.0]])


def weighted(resample: Callable[[Image], Image], image: Image, weights: Image | None) -> Image:
    """An image `(H, W)` or `(H, W, K)`, resampled so that pixels do not mix with those that have no weight.

    Args:
        resample: takes weighted means of pixels, as those that resize and remap do.
        image: one whose hidden pixels may have any colour: transparent ones, or those that a mask leaves out.
        weights: how much of each pixel is seen, `(H, W)` in [0, 1]; None: all of it.

    Returns:
        The weighted means; plain ones where nothing is seen.
    """
    plain = resample(image)
    if weights is None:
        return plain
    total = resample(weights)
    seen = resample(image * (weights[..., None] if image.ndim == 3 else weights))
    if image.ndim == 3:
        total = total[..., None]
    return np.asarray(np.where(total > _MIN_WEIGHT, seen / np.maximum(total, _MIN_WEIGHT), plain), np.float32)


def reduce(image: Image, width: int, height: int, weights: Image | None = None) -> Image:
    """Reduce an image `(H, W)` or `(H, W, K)` to means over areas, weighted as :func:`weighted` says."""
    if image.shape[1::-1] == (width, height):
        return image
    area = partial(cv2.resize, dsize=(width, height), interpolation=cv2.INTER_AREA)
    return np.clip(weighted(area, image, weights), 0.0, 1.0).astype(np.float32)  # type: ignore[arg-type]  # OpenCV's


def resize(
    image: Image, intrinsics: Intrinsics, width: int, height: int, weights: Image | None = None
) -> tuple[Image, Intrinsics]:
    """Reduce an image as :func:`reduce` does, its intrinsics by the exact ratio of each axis."""
    if (width, height) == (intrinsics.width, intrinsics.height):
        return image, intrinsics
    return reduce(image, width, height, weights), intrinsics.scaled(width, height)


def remap(image: Image, maps: Maps | None, weights: Image | None = None) -> Image:
    """Take each pixel from its position in the maps, weighted as :func:`weighted` says; without maps the image."""
    if maps is None:
        return image

    def linear(values: Image) -> Image:
        return np.asarray(cv2.remap(values, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)

    return weighted(linear, image, weights)


def rectification(intrinsics: Intrinsics) -> tuple[Intrinsics, Maps | None]:
    """The pinhole camera that replaces a lens, and the positions of its pixels in the lens's image.

    The principal point stays. The focal length stays too, unless that would leave pixels blank (pincushion distortion):
    then it grows, by one factor on both axes, until the image covers every pixel. The positions are x and y, `(H, W)`
    each, or None without distortion. A ValueError if coefficients fold the image, or it is too long for OpenCV.
    """
    if not intrinsics.fisheye and not any(intrinsics.distortion):
        return replace(intrinsics, distortion=()), None
    width, height = intrinsics.width, intrinsics.height
    if max(width, height) > _LONGEST_REMAPPED:
        raise ArgumentError("distortion", f"at most {_LONGEST_REMAPPED} pixels a side to undo it", max(width, height))
    zoom = _covering_zoom(intrinsics)
    pinhole = replace(intrinsics, fx=intrinsics.fx * zoom, fy=intrinsics.fy * zoom, distortion=(), fisheye=False)
    rectify = cv2.fisheye.initUndistortRectifyMap if intrinsics.fisheye else cv2.initUndistortRectifyMap
    matrix = intrinsics.matrix()
    distortion = np.array(intrinsics.distortion)
    x, y = rectify(matrix, distortion, np.eye(3), pinhole.matrix(), (width, height), cv2.CV_32FC1)
    inside = x.min() >= -0.5 and y.min() >= -0.5 and x.max() <= width - 0.5 and y.max() <= height - 0.5
    if not inside or np.diff(x, axis=1).min(initial=1.0) <= 0 or np.diff(y, axis=0).min(initial=1.0) <= 0:
        expected = "coefficients that neither fold the image nor map it outside itself"
        raise ArgumentError("distortion", expected, intrinsics.distortion)
    return pinhole, (np.asarray(x, np.float32), np.asarray(y, np.float32))


def _covering_zoom(intrinsics: Intrinsics) -> float:
    """The smallest factor on the focal length, from 1 to 2, with which the pinhole's border lies inside the image."""
    width, height = intrinsics.width, intrinsics.height
    matrix = intrinsics.matrix()
    project = cv2.fisheye.projectPoints if intrinsics.fisheye else cv2.projectPoints
    rows = [(x, y) for x in range(width) for y in (0, height - 1)]
    border = np.array(rows + [(x, y) for x in (0, width - 1) for y in range(height)], np.float64)
    rays = (border - matrix[:2, 2]) / (intrinsics.fx, intrinsics.fy)

    def covered(zoom: float) -> bool:
        points = np.insert(rays / zoom, 2, 1.0, axis=1)[:, None]
        pixels = project(points, np.zeros(3), np.zeros(3), matrix, np.array(intrinsics.distortion))[0]
        return bool((np.abs(pixels * 2 - (width - 1, height - 1)) <= (width - 1 + 1e-6, height - 1 + 1e-6)).all())

    if covered(1.0):
        return 1.0
    low, high = 1.0, 2.0
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (low, middle) if covered(middle) else (middle, high)
    return high
