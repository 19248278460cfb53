"""Packs a splat into few bytes for the viewer: fixed-point numbers, stored in planes of bytes, compressed with gzip.

The format: `count` Gaussians, stored in columns of one number per Gaussian. A column consists of `width` planes of
`count` bytes each; the first plane holds the most significant bytes. A value is `low + step * integer`.

Positions are in world units, scales are natural logarithms. Quaternions w, x, y, z have length 1 and lack the component
with the largest magnitude, which is positive and whose index is `largest`; the other three are stored in order.
Harmonics are the signed square roots of the coefficients, so that small ones keep more digits: a coefficient is
`value * |value|`. Their order is that of PLY files: by coefficient, then r, g, b.

Foreign splats can hold values that are far from all others. A column that has some gets more bits, so that the others
keep their digits; Gaussians that are far from everything are left out.
"""

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from numpy.typing import NDArray
from torch import Tensor

from kgs._support.errors import ArgumentError, quantity
from kgs.geometry.cameras import project, select, to
from kgs.geometry.harmonics import SH_C0
from kgs.geometry.multiview import inside_images
from kgs.geometry.projection import finite_gaussians
from kgs.geometry.rigs import camera_centers
from kgs.geometry.types import SH_SIZES, Gaussians, RasterOptions

from .cameras import Array

PIXEL_ERROR = 0.01  # largest shift of a Gaussian's centre by rounding, in pixels of the given cameras
FINE = 16  # bits per number
COARSE = 8  # bits per number, where the limit of size asks for it
_POSITION_BITS = 8, 48  # fewest and most bits of a coordinate
_STRAY = 1e5  # times the median distance from the middle: no sky is so far away
_MAX_COEFFICIENT = 1e4  # larger ones are lowered to this one, with which a colour is white or black, too
_BULK = 0.99  # share of the values of a column whose digits are kept whatever the others are
_MAX_SPREAD = 8.0  # times the range of these values: what the whole range may be without more bits
_MAX_BITS = 48  # of any number: JavaScript has whole numbers of 53
_MIN_SCALE = 1e-12  # smaller scales are raised to this one, whose logarithm is finite
_CELL_BITS = 16  # bits per axis of the cells that sort Gaussians by their position
_GZIP_HEADER = b"\x1f\x8b\x08" + bytes(6) + b"\xff"  # without file name, time and operating system
_LAST_BLOCK = b"\x03\0"  # an empty DEFLATE block that ends the stream
_TARGET_SHARE = 0.97  # share of the limit to aim at when Gaussians are left out


class Packed(NamedTuple):
    """A packed splat."""

    layout: dict[str, Any]  # `count`, `degree` of the harmonics, and `columns` with the name, width, low, step of each
    content: bytes  # the planes of all columns as one gzip file
    reduced: str = ""  # strays that were left out, and what the limit of size reduced, in words that follow "it shows"


class Column(NamedTuple):
    """One number per Gaussian in fixed point: `low + step * integers`, each integer `width` bytes wide."""

    name: str
    width: int
    low: float
    step: float
    integers: NDArray[np.uint64]

    def planes(self) -> bytes:
        """The most significant bytes of all Gaussians, then the next bytes, down to the least significant ones."""
        shifts = range(8 * (self.width - 1), -1, -8)
        return b"".join((self.integers >> np.uint64(shift)).astype(np.uint8).tobytes() for shift in shifts)


def pack(
    gaussians: Gaussians,  # with harmonics, or RGB colours `(N, 3)`
    cameras: PinholeCamera,  # of the page: positions get as many bits as their images need, see `PIXEL_ERROR`
    max_bytes: int,  # of the content
    weights: Callable[[], Tensor] | None = None,
    near_plane: float = RasterOptions.near_plane,
) -> Packed:
    """Pack Gaussians into at most `max_bytes` bytes; an ArgumentError if not even one fits.

    Invisible Gaussians are always left out: those that are not finite, or have an opacity below the alpha threshold. So
    are strays, which are more than 100 000 times as far from the middle as Gaussians or cameras are in the median; what
    lies nearer may be seen when an eye turns, and stays. If the rest is too large, first the numbers get fewer bits,
    then the harmonics a lower degree, and only then are Gaussians left out: those first whose contribution is the
    smallest, which `weights` returns, `(N,)`. Without it that is opacity times area.
    """
    values, visible = _visible(gaussians)
    values = {name: value.astype(np.float64) for name, value in values.items()}
    near = ~_strays(values["means"], cameras)
    rows = visible[near]
    strays = len(visible) - len(rows)
    words = [f"all but {quantity(strays, 'stray Gaussian')}"] if strays else []
    values = {name: value[near] for name, value in values.items()}
    degree = SH_SIZES.index(values["colors"].shape[1])
    packed = Packed({}, b"")
    reductions = list[str]()
    for packed, reductions in _with_all_gaussians(values, cameras, near_plane, degree):
        if len(packed.content) <= max_bytes:
            return packed._replace(reduced=", ".join(words + reductions))
    if weights is None:
        scales = np.sort(values["scales"], axis=1)
        contributions = values["opacities"] * scales[:, 1] * scales[:, 2]
    else:
        contributions = weights().detach().cpu().double().numpy()[rows]
    order = np.argsort(-contributions, kind="stable")
    count = len(rows)
    while len(packed.content) > max_bytes:
        count = min(count - 1, math.floor(_TARGET_SHARE * count * max_bytes / len(packed.content)))
        if count < 1:
            raise ArgumentError("max_bytes", "room for a Gaussian", f"{max_bytes} bytes")
        chosen = {name: value[order[:count]] for name, value in values.items()}
        packed = _gzip(_compressed_columns(chosen, cameras, near_plane, COARSE, 0), 0)
    words += [*reductions, f"{count} of {len(rows)} Gaussians"]
    return packed._replace(reduced=", ".join(words))


def _visible(gaussians: Gaussians) -> tuple[dict[str, NDArray[Any]], NDArray[np.intp]]:
    """The values of the visible Gaussians, with harmonics that a viewer can draw, and which rows these are."""
    values = {name: value.detach().cpu().numpy() for name, value in vars(gaussians).items()}
    if values["colors"].ndim == 2:
        values["colors"] = (values["colors"][:, None].astype(np.float64) - 0.5) / SH_C0
    finite = finite_gaussians(gaussians).cpu().numpy()
    rows = np.flatnonzero(finite & (values["opacities"].astype(np.float64) >= RasterOptions.alpha_threshold))
    values = {name: value[rows] for name, value in values.items()}
    values["colors"] = values["colors"].clip(-_MAX_COEFFICIENT, _MAX_COEFFICIENT)
    return values, rows


def _strays(means: Array, cameras: PinholeCamera) -> NDArray[np.bool_]:
    """Which of the centres `(N, 3)` are far from all others and from the cameras, and so no part of a scene."""
    if not len(means):
        return np.zeros(0, bool)
    middle = np.median(means, axis=0)
    distances = np.linalg.norm(means - middle, axis=1)
    to_cameras = np.linalg.norm(camera_centers(cameras.extrinsics).numpy() - middle, axis=1)
    usual = max(np.median(distances), np.median(to_cameras))
    strays: NDArray[np.bool_] = (distances > _STRAY * usual) & (usual > 0)
    return strays


def _with_all_gaussians(
    values: dict[str, Array], cameras: PinholeCamera, near_plane: float, degree: int
) -> Iterator[tuple[Packed, list[str]]]:
    """All Gaussians in fewer and fewer bytes, with what was reduced: the bits per number, then the degree."""
    yield _gzip(_compressed_columns(values, cameras, near_plane, FINE, degree), degree), []
    columns = _compressed_columns(values, cameras, near_plane, COARSE, degree)
    for lower in range(degree, -1, -1):
        dropped = 3 * (SH_SIZES[degree] - SH_SIZES[lower])  # the last columns
        reductions = ["8-bit numbers"]
        if lower < degree:
            reductions.append(f"harmonics up to degree {lower} of {degree}")
        yield _gzip(columns[: len(columns) - dropped], lower), reductions


def _compressed_columns(
    values: dict[str, Array], cameras: PinholeCamera, near_plane: float, bits: int, degree: int
) -> list[tuple[Column, bytes]]:
    """The columns, and the DEFLATE blocks of each, which do not depend on other columns and end at a byte boundary."""
    order = _morton_order(values["means"])
    ordered = {name: value[order] for name, value in values.items()}
    pixels_per_unit = _pixels_per_unit(ordered["means"], cameras, near_plane)
    compressed = list[tuple[Column, bytes]]()
    for column in _columns(ordered, pixels_per_unit, bits, degree):
        deflate = zlib.compressobj(6, zlib.DEFLATED, -zlib.MAX_WBITS)
        compressed.append((column, deflate.compress(column.planes()) + deflate.flush(zlib.Z_FULL_FLUSH)))
    return compressed


def _gzip(columns: list[tuple[Column, bytes]], degree: int) -> Packed:
    """One gzip file of compressed columns (RFC 1952)."""
    layout = {
        "count": len(columns[0][0].integers),
        "degree": degree,
        "columns": [[column.name, column.width, column.low, column.step] for column, _ in columns],
    }
    checksum = 0
    size = 0
    for column, _ in columns:
        planes = column.planes()
        checksum = zlib.crc32(planes, checksum)
        size += len(planes)
    blocks = b"".join(deflated for _, deflated in columns)
    trailer = struct.pack("<II", checksum, size % 2**32)
    return Packed(layout, _GZIP_HEADER + blocks + _LAST_BLOCK + trailer)


def _columns(values: dict[str, Array], pixels_per_unit: float, bits: int, degree: int) -> Iterator[Column]:
    """All numbers of the Gaussians in fixed point, the harmonics last."""
    largest_step = 2 * PIXEL_ERROR / math.sqrt(3) / max(pixels_per_unit, 1e-12)
    min_bits, max_bits = _POSITION_BITS
    for name, column in _numbers(values, degree):
        if name in ("x", "y", "z"):
            span = float(np.ptp(column)) if len(column) else 0.0
            needed = math.ceil(math.log2(span / largest_step + 2))
            yield _spread_out(name, column, min(max_bits, max(min_bits, needed)))
        elif name == "largest":
            yield Column(name, 1, 0.0, 1.0, column.astype(np.uint64))
        else:
            is_of_higher_degree = name.startswith("sh") and not name.startswith("sh0")
            yield _fixed_point(name, column, COARSE if is_of_higher_degree else bits)


def _numbers(values: dict[str, Array], degree: int) -> Iterator[tuple[str, Array]]:
    """All numbers of the Gaussians by the names of their columns, the harmonics last."""
    yield from zip("xyz", values["means"].T, strict=True)

    for axis, column in enumerate(np.log(values["scales"].clip(_MIN_SCALE)).T):
        yield f"scale{axis}", column

    norms = np.linalg.norm(values["quats"], axis=1, keepdims=True)
    quats = np.where(norms > 0, values["quats"] / np.where(norms > 0, norms, 1.0), [1.0, 0.0, 0.0, 0.0])
    largest = np.abs(quats).argmax(axis=1)
    quats = quats * np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    others = quats[np.arange(4) != largest[:, None]].reshape(-1, 3)
    yield "largest", largest
    for i, column in enumerate(others.T):
        yield f"quat{i}", column

    yield "opacity", values["opacities"]

    for k in range(SH_SIZES[degree]):
        for channel in range(3):
            column = values["colors"][:, k, channel]
            yield f"sh{k}{'rgb'[channel]}", np.sign(column) * np.sqrt(np.abs(column))


def _fixed_point(name: str, values: Array, bits: int) -> Column:
    """A column whose integers of `bits` bits, or more where few values are far from all others, cover the values."""
    if not len(values):
        return _spread_out(name, values, bits)
    bulk = 2 * float(np.quantile(np.abs(values - np.median(values)), _BULK, method="lower"))
    spread = float(np.ptp(values)) / (_MAX_SPREAD * bulk) if bulk > 0 else 0.0
    more = math.ceil(math.log2(spread)) if spread > 1 else 0
    return _spread_out(name, values, min(_MAX_BITS, bits + more))


def _spread_out(name: str, values: Array, bits: int) -> Column:
    """A column whose integers of `bits` bits cover the range of the values."""
    low = float(values.min()) if len(values) else 0.0
    high = float(values.max()) if len(values) else 0.0
    step = (high - low) / (2**bits - 1) or 1.0
    integers = np.rint((values - low) / step).astype(np.uint64)
    return Column(name, math.ceil(bits / 8), low, step, integers)


def _pixels_per_unit(means: Array, cameras: PinholeCamera, near_plane: float) -> float:
    """The largest shift of a centre in an image that shows it, in pixels, when it moves by one world unit."""
    maximum = 0.0
    points = torch.from_numpy(means)
    for i in range(cameras.batch_size):
        camera = to(select(cameras, i), "cpu", torch.float64)
        pixels, depths = project(camera, points)
        seen = inside_images(camera, pixels, depths, near_plane)[:, 0]
        if seen.any():
            k = camera.intrinsics[0]
            tangents = (pixels[seen, 0] - k[:2, 2]) / k.diagonal()[:2]
            shifts = k.diagonal()[:2].abs().max() / depths[seen, 0] * (1 + tangents.square().sum(1)).sqrt()
            maximum = max(maximum, float(shifts.max()))
    return maximum


def _morton_order(means: Array) -> NDArray[np.intp]:
    """An order along a Morton curve, in which Gaussians mostly follow their neighbours: it compresses better."""
    ranks = means.argsort(axis=0, kind="stable").argsort(axis=0, kind="stable").astype(np.uint64)
    cells = ranks * np.uint64(2**_CELL_BITS) // np.uint64(max(1, len(means)))
    codes = np.zeros(len(means), np.uint64)
    for bit in range(_CELL_BITS):
        for axis in range(3):
            codes |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(codes, kind="stable")
