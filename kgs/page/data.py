"""A splat in few bytes, for the viewer: each number in fixed point, in planes of bytes that gzip shortens well.

What a viewer decodes: `count` Gaussians in columns; of each column `width` planes of `count` bytes, the highest byte
first. A value is `low + step * integer`. Positions are in world units, scales natural logarithms. Of a unit quaternion
w, x, y, z the component `largest` is left out, which is positive; the other three follow in order. Harmonics are
`value * |value|` of what is stored, so that small ones keep their digits, in the order of PLY files: k, then r, g, b.
"""

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from kornia.geometry.camera import PinholeCamera
from numpy.typing import NDArray
from torch import Tensor

from kgs.harmonics import SH_C0
from kgs.projection import finite_gaussians
from kgs.types import SH_SIZES, Gaussians, RasterOptions

from .cameras import Array, in_picture, lenses

PIXEL_ERROR = 0.01  # by which fixed point may move a centre in a picture of the given cameras, in pixels
FINE, COARSE = 16, 8  # bits of a number
_MOST_BITS = 32  # of a position
_SMALLEST = 1e-12  # scale that has a logarithm
_CELL_BITS = 16  # of a coordinate in the order of neighbours
_GZIP_HEADER = b"\x1f\x8b\x08" + bytes(6) + b"\xff"  # no name, no time, no system
_LAST_BLOCK = b"\x03\0"  # empty
_FIT = 0.97  # of the room is aimed at when Gaussians have to go


class Packed(NamedTuple):
    """A splat for the page."""

    layout: dict[str, Any]  # count, degree, columns: what a viewer decodes by
    content: bytes  # gzip of the planes
    left_out: str  # what the limit of size cost, in words; "" for nothing


class Column(NamedTuple):
    """One number of each Gaussian, in fixed point."""

    name: str
    width: int  # bytes
    low: float
    step: float
    integers: NDArray[np.uint64]

    def planes(self) -> bytes:
        """The highest bytes of all Gaussians, then the next ones."""
        shifts = range(8 * (self.width - 1), -1, -8)
        return b"".join((self.integers >> np.uint64(s)).astype(np.uint8).tobytes() for s in shifts)


def pack(
    gaussians: Gaussians,
    cameras: PinholeCamera,
    most_bytes: int,
    weights: Callable[[], Tensor] | None = None,
    near_plane: float = RasterOptions.near_plane,
) -> Packed:
    """The Gaussians in at most so many bytes.

    What no picture shows is left out: Gaussians that are not finite, or fainter than the threshold of alpha. Where the
    rest is too large numbers get fewer bits, then harmonics a lower degree, and only then are Gaussians left out.

    Args:
        gaussians: with harmonics, or RGB `(N, 3)`.
        cameras: those that the page has; positions get as many bits as their pictures need, see `PIXEL_ERROR`.
        most_bytes: of the result's content.
        weights: what each Gaussian contributes, `(N,)`; asked for where some have to go. None: opacity times area.
        near_plane: of the renderer, in world units.

    Raises:
        ValueError: not even one Gaussian fits.
    """
    values = {name: value.detach().cpu().double().numpy() for name, value in vars(gaussians).items()}
    if values["colors"].ndim == 2:
        values["colors"] = (values["colors"][:, None] - 0.5) / SH_C0
    finite = finite_gaussians(gaussians).cpu().numpy()
    rows = np.flatnonzero(finite & (values["opacities"] >= RasterOptions.alpha_threshold))
    values = {name: value[rows] for name, value in values.items()}
    degree = SH_SIZES.index(values["colors"].shape[1])
    found, said = Packed({}, b"", ""), list[str]()
    for found, said in _attempts(values, cameras, near_plane, degree):
        if len(found.content) <= most_bytes:
            return found._replace(left_out=", ".join(said))
    worth = _worth(values) if weights is None else weights().detach().cpu().double().numpy()[rows]
    order, kept = np.argsort(-worth, kind="stable"), len(rows)
    while len(found.content) > most_bytes:
        kept = min(kept - 1, math.floor(_FIT * kept * most_bytes / len(found.content)))
        if kept < 1:
            raise ValueError(f"most_bytes: expected room for a Gaussian, got {most_bytes} bytes")
        some = {name: value[order[:kept]] for name, value in values.items()}
        found = _joined(_compressed(some, cameras, near_plane, COARSE, 0), 0)
    return found._replace(left_out=", ".join([*said, f"{kept} of {len(rows)} Gaussians"]))


def _attempts(
    values: dict[str, Array], cameras: PinholeCamera, near_plane: float, degree: int
) -> Iterator[tuple[Packed, list[str]]]:
    """All Gaussians in ever fewer bytes, and what that cost: bits of the numbers, then degrees of the harmonics."""
    yield _joined(_compressed(values, cameras, near_plane, FINE, degree), degree), []
    columns = _compressed(values, cameras, near_plane, COARSE, degree)
    for lower in range(degree, -1, -1):
        count = len(columns) - 3 * (SH_SIZES[degree] - SH_SIZES[lower])
        cost = [f"harmonics up to degree {lower} of {degree}"] if lower < degree else []
        yield _joined(columns[:count], lower), ["numbers of 8 bits", *cost]


def _compressed(
    values: dict[str, Array], cameras: PinholeCamera, near_plane: float, bits: int, degree: int
) -> list[tuple[Column, bytes]]:
    """The columns, and each in DEFLATE blocks that refer to no other and end at a byte."""
    near, found = _neighbours_together(values["means"]), list[tuple[Column, bytes]]()
    some = {name: value[near] for name, value in values.items()}
    for column in _columns(some, _pixels_per_unit(some["means"], cameras, near_plane), bits, degree):
        deflate = zlib.compressobj(6, zlib.DEFLATED, -zlib.MAX_WBITS)
        found.append((column, deflate.compress(column.planes()) + deflate.flush(zlib.Z_FULL_FLUSH)))
    return found


def _joined(columns: list[tuple[Column, bytes]], degree: int) -> Packed:
    """One gzip file of columns (RFC 1952)."""
    described = [[column.name, column.width, column.low, column.step] for column, _ in columns]
    count, check, size = len(columns[0][0].integers), 0, 0
    for column, _ in columns:
        planes = column.planes()
        check, size = zlib.crc32(planes, check), size + len(planes)
    content = _GZIP_HEADER + b"".join(deflated for _, deflated in columns) + _LAST_BLOCK
    content += struct.pack("<II", check, size % 2**32)
    return Packed({"count": count, "degree": degree, "columns": described}, content, "")


def _columns(values: dict[str, Array], pixels_per_unit: float, bits: int, degree: int) -> Iterator[Column]:
    means, norms = values["means"], np.linalg.norm(values["quats"], axis=1, keepdims=True)
    finest = 2 * PIXEL_ERROR / math.sqrt(3) / max(pixels_per_unit, 1e-12)
    for name, column in zip("xyz", means.T, strict=True):
        span = float(np.ptp(column)) if len(column) else 0.0
        yield _fixed(name, column, min(_MOST_BITS, max(8, math.ceil(math.log2(span / finest + 2)))))
    for axis, column in enumerate(np.log(values["scales"].clip(_SMALLEST)).T):
        yield _fixed(f"scale{axis}", column, bits)
    quats = np.where(norms > 0, values["quats"] / np.where(norms > 0, norms, 1.0), [1.0, 0.0, 0.0, 0.0])
    largest = np.abs(quats).argmax(axis=1)
    quats = quats * np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    others = quats[np.arange(4) != largest[:, None]].reshape(-1, 3)
    yield Column("largest", 1, 0.0, 1.0, largest.astype(np.uint64))
    for axis, column in enumerate(others.T):
        yield _fixed(f"turn{axis}", column, bits)
    yield _fixed("opacity", values["opacities"], bits)
    for k in range(SH_SIZES[degree]):
        for channel in range(3):
            column = values["colors"][:, k, channel]
            yield _fixed(f"sh{k}{'rgb'[channel]}", np.sign(column) * np.sqrt(np.abs(column)), COARSE if k else bits)


def _fixed(name: str, values: Array, bits: int) -> Column:
    """The values between their bounds, in so many bits."""
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    step = (high - low) / (2**bits - 1) or 1.0
    return Column(name, math.ceil(bits / 8), low, step, np.rint((values - low) / step).astype(np.uint64))


def _pixels_per_unit(means: Array, cameras: PinholeCamera, near_plane: float) -> float:
    """By how many pixels at most a centre moves in a picture that shows it when it is moved by a world unit."""
    most = 0.0
    for k, pose, size in lenses(cameras):
        points = in_picture(means, k, pose, size, near_plane)
        tangents = points[:, :2] / points[:, 2:]
        slopes = np.abs(k.diagonal()[:2]).max() / points[:, 2] * np.sqrt(1 + (tangents**2).sum(axis=1))
        most = max(most, float(slopes.max(initial=0.0)))
    return most


def _worth(values: dict[str, Array]) -> Array:
    """Opacity times the largest area that a Gaussian can show."""
    scales = np.sort(values["scales"], axis=1)
    worth: Array = values["opacities"] * scales[:, 1] * scales[:, 2]
    return worth


def _neighbours_together(means: Array) -> NDArray[np.intp]:
    """An order in which neighbours in space mostly follow each other (along a Morton curve): it compresses better."""
    ranks = means.argsort(axis=0, kind="stable").argsort(axis=0, kind="stable").astype(np.uint64)
    cells = ranks * np.uint64(2**_CELL_BITS) // np.uint64(max(1, len(means)))
    code = np.zeros(len(means), np.uint64)
    for bit in range(_CELL_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")
