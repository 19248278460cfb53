"""The layout of PlayCanvas's compressed splats: codes of a few bits within the ranges of 256 Gaussians, and back.

Source: PlayCanvas, "Compressing Gaussian Splats", 2024, https://blog.playcanvas.com/compressing-gaussian-splats; how
codes become numbers again was compared in the readers of playcanvas 2.23.3 and GaussianSplats3D 0.4.7.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from kgs.geometry.harmonics import SH_C0

CHUNK = 256  # Gaussians that share the ranges of their values
BITS_OF_VECTOR = (11, 10, 11)  # of x, y and z in a position, or of the three scales
BITS_OF_COLOR = (8, 8, 8, 8)  # of red, green, blue and the opacity
BITS_OF_ROTATION = (2, 10, 10, 10)  # of the index of the largest component, and of the other three
ROTATION_RANGE = float(np.sqrt(0.5))  # of the other components: from minus it to it
SH_RANGE = 4.0  # harmonics of degree 1 and above are within -4 and 4
_RANGES = ("xyz", ("scale_x", "scale_y", "scale_z"), "rgb")  # properties of a chunk
BOUNDS = [f"{end}_{name}" for names in _RANGES for end in ("min", "max") for name in names]
PACKED = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
Columns = Mapping[str, NDArray[np.generic]]


def pack(codes: NDArray[np.uint32], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """One integer for each row of codes, the first of them in its highest bits, `(N,)`."""
    packed = np.zeros(len(codes), np.uint32)
    for k, count in enumerate(bits):
        packed = (packed << np.uint32(count)) | codes[:, k]
    return packed


def unpack(packed: NDArray[np.generic], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """The codes of :func:`pack`, `(N, len(bits))`."""
    rest = packed.astype(np.uint32)
    codes = []
    for count in reversed(bits):
        codes.append(rest & np.uint32(2**count - 1))
        rest = rest >> np.uint32(count)
    return np.stack(codes[::-1], axis=1)


def unpacked(chunk: Columns, vertex: Columns, sh: Columns) -> dict[str, NDArray[np.generic]]:
    """The properties of a plain splat, `(N,)` each, from those of a compressed one's elements."""
    positions = _within(chunk, "xyz", unpack(vertex["packed_position"], BITS_OF_VECTOR), BITS_OF_VECTOR)
    scales = _within(chunk, _RANGES[1], unpack(vertex["packed_scale"], BITS_OF_VECTOR), BITS_OF_VECTOR)
    codes = unpack(vertex["packed_color"], BITS_OF_COLOR)
    colors = (_within(chunk, "rgb", codes[:, :3], BITS_OF_COLOR) - 0.5) / SH_C0
    opacities = codes[:, 3] / 255.0
    with np.errstate(divide="ignore"):
        logits = np.log(opacities) - np.log1p(-opacities)  # of 0 and 1 they are infinite
    columns: dict[str, NDArray[np.generic]] = dict(zip("xyz", positions.T, strict=True))
    columns |= {f"f_dc_{i}": column for i, column in enumerate(colors.T)}
    columns |= {name: values.astype(np.float64) * (2 * SH_RANGE / 255) - SH_RANGE for name, values in sh.items()}
    columns |= {"opacity": logits}
    columns |= {f"scale_{i}": column for i, column in enumerate(scales.T)}
    columns |= {f"rot_{i}": column for i, column in enumerate(_rotations(vertex["packed_rotation"]).T)}
    return columns


def _within(
    chunk: Columns, names: str | tuple[str, ...], codes: NDArray[np.uint32], bits: tuple[int, ...]
) -> NDArray[np.float64]:
    """The numbers that codes stand for, between the smallest and the largest of their chunk, `(N, 3)`."""
    rows = np.arange(len(codes)) // CHUNK
    columns = []
    for name, code, count in zip(names, codes.T, bits, strict=False):
        share = code / (2.0**count - 1)
        low, high = (chunk[f"{end}_{name}"].astype(np.float64)[rows] for end in ("min", "max"))
        columns.append(low * (1 - share) + high * share)
    return np.stack(columns, axis=1)


def _rotations(packed: NDArray[np.generic]) -> NDArray[np.float64]:
    """Quaternions w, x, y, z of length 1 whose largest component is positive, `(N, 4)`."""
    codes = unpack(packed, BITS_OF_ROTATION)
    largest = codes[:, :1].astype(np.intp)
    kept = (codes[:, 1:] / 1023.0 * 2 - 1) * ROTATION_RANGE
    quats = np.empty((len(codes), 4))
    others = np.arange(3) + (np.arange(3) >= largest)
    np.put_along_axis(quats, others, kept, axis=1)
    left = np.sqrt(np.maximum(1 - (kept**2).sum(axis=1, keepdims=True), 0.0))
    np.put_along_axis(quats, largest, left, axis=1)
    return quats
