"""Splats as compressed PLY files of PlayCanvas, a quarter of the bytes of a plain PLY, for viewers in browsers.

More viewers read this layout than SOG, the other compressed one: SuperSplat, PlayCanvas, Spark and Babylon.js read
both, GaussianSplats3D only this one. Files of SOG take 0.68 to 0.86 of its bytes (docs/results/viewers).
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kgs._support.checks import check_kind
from kgs._support.errors import ArgumentError
from kgs._support.json_files import write_whole
from kgs.geometry.harmonics import SH_C0
from kgs.geometry.types import SH_SIZES
from kgs.model import GaussianModel
from kgs.packed_ply import (
    BITS_OF_COLOR,
    BITS_OF_ROTATION,
    BITS_OF_VECTOR,
    BOUNDS,
    CHUNK,
    PACKED,
    ROTATION_RANGE,
    SH_RANGE,
    pack,
)
from kgs.ply import as_vector

__all__ = ["save_compressed_ply"]

_FLATTEST = 16.0  # an axis of less than exp(-16) of the longest, 1e-7, is as thick as that
_LOG_FLOATS = (-87.0, 88.0)  # logarithms of the smallest and the largest float32
_GOLDEN = 0.6180339887498949  # the fractions of its multiples are spread evenly over [0, 1)


def save_compressed_ply(path: str | os.PathLike[str], model: GaussianModel, offset: Tensor | None = None) -> None:
    """Write a model as a compressed PLY file, with harmonics up to the active degree. The write is atomic.

    A Gaussian takes 16 bytes, and 9, 24 or 45 more for harmonics of degree 1, 2 or 3; each 256 Gaussians share the
    ranges of their positions, log scales and colours (72 bytes). The numbers are rounded: positions, by axis, to a
    2047th, 1023rd and 2047th of the range of the 256, log scales likewise, rotations to 0.3 degrees, colours to a
    255th of their range, opacities to a 255th. Harmonics of degree 1 and above are clamped to [-4, 4] and become one of
    the two nearest 255ths of it, such that the errors of neighbours cancel; the highest bands are left out if they are
    zero in all Gaussians. An axis thinner than exp(-16) of the Gaussian's longest is written as thick as that.

    The Gaussians are in another order than in the model: near ones share their ranges. The same model gives the same
    bytes.

    Convention:
        The axes, positions and scales of the model. Ranges of positions are float32: far from the origin, as in map
        coordinates, they are rounded, and viewers cannot show the splat. Leave the offset out then.

    Args:
        path: the file to write, in an existing folder. Viewers expect a name that ends in `.compressed.ply` or `.ply`.
        model: the Gaussians, at least one.
        offset: added in float64 to the means on the way out, `(3,)`; the `offset` of a Scene. None: zero.

    Raises:
        TypeError: `model` is not a GaussianModel.
        ValueError: `model` has no Gaussians, a value is not finite in float32, or `offset` has another shape.
        OSError: the file cannot be written.
    """
    check_kind("model", model, GaussianModel)
    if not len(model):
        raise ArgumentError("model", "at least one Gaussian", "none")
    values = {name: parameter.detach().cpu().double().numpy() for name, parameter in model.per_gaussian().items()}
    if offset is not None:
        values["means"] = values["means"] + as_vector("offset", offset)
    _check_finite(values)
    order = _in_chunks(values["means"])
    values = {name: array[order] for name, array in values.items()}
    low_means, high_means, means = _code_in_chunks(values["means"], BITS_OF_VECTOR)
    low_scales, high_scales, scales = _code_in_chunks(_finite_scales(values["log_scales"]), BITS_OF_VECTOR)
    low_colors, high_colors, colors = _code_in_chunks(values["sh_dc"][:, 0] * SH_C0 + 0.5, (8, 8, 8))
    opacities = _code(torch.from_numpy(values["opacity_logits"]).sigmoid().numpy(), 0.0, 1.0, 8)
    chunks = np.hstack([low_means, high_means, low_scales, high_scales, low_colors, high_colors])
    rows = [
        pack(means, BITS_OF_VECTOR),
        _pack_rotations(values["quats"]),
        pack(scales, BITS_OF_VECTOR),
        pack(np.column_stack([colors, opacities]), BITS_OF_COLOR),
    ]
    harmonics = _code_harmonics(values["sh_rest"][:, : SH_SIZES[model.sh_degree] - 1])
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment kgs sh_degree {model.sh_degree}",
        *(["comment SplatRenderMode: mip"] if model.antialiased else []),
        f"element chunk {len(chunks)}",
        *(f"property float {name}" for name in BOUNDS),
        f"element vertex {len(model)}",
        *(f"property uint {name}" for name in PACKED),
    ]
    if harmonics.shape[1]:
        lines.append(f"element sh {len(model)}")
        lines += [f"property uchar f_rest_{i}" for i in range(harmonics.shape[1])]
    header = "".join(f"{line}\n" for line in [*lines, "end_header"])
    body = (chunks.astype("<f4"), np.column_stack(rows).astype("<u4"), harmonics)
    write_whole(Path(path), header.encode("ascii") + b"".join(part.tobytes() for part in body))


def _check_finite(values: dict[str, NDArray[np.float64]]) -> None:
    """A ValueError where a parameter is not finite in float32.

    But the logarithm of a flat disc's scale is -inf, and the logits of the opacities 1 and 0 are inf and -inf.
    """
    for name, array in values.items():
        invalid = ~(np.abs(array) <= np.finfo(np.float32).max)
        if name == "log_scales":
            invalid &= array != -np.inf
        if name == "opacity_logits":
            invalid = np.isnan(array)
        if invalid.any():
            raise ArgumentError("model", "values that are finite in float32", f"{array[invalid][0]} in {name}")


def _finite_scales(log_scales: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log scales without -inf: no axis is longer than a float32, or thinner than what `_FLATTEST` allows, `(N, 3)`."""
    thinnest = log_scales.max(axis=1, keepdims=True) - _FLATTEST
    finite: NDArray[np.float64] = np.clip(np.maximum(log_scales, thinnest), *_LOG_FLOATS)
    return finite


def _in_chunks(means: NDArray[np.float64]) -> NDArray[np.intp]:
    """An order of the Gaussians in which each 256 are near each other: a tree of boxes, split where they get smallest.

    A split leaves each side at least an eighth of the chunks, which bounds the depth of the tree.
    """
    steps = means / (2.0 ** np.array(BITS_OF_VECTOR) - 1.0)  # in these units, codes of all three axes are as coarse
    waiting = [np.arange(len(means))]
    done = []
    while waiting:
        rows = waiting.pop()
        chunks = -(-len(rows) // CHUNK)
        if chunks == 1:
            done.append(rows)
            continue
        axis = np.ptp(steps[rows], axis=0).argmax()
        rows = rows[np.argsort(steps[rows, axis], kind="stable")]
        minimum = max(1, chunks // 8)
        cuts = np.arange(minimum, chunks - minimum + 1) * CHUNK
        before = _sizes_of_boxes(steps[rows])[cuts - 1]
        behind = _sizes_of_boxes(steps[rows[::-1]])[len(rows) - cuts - 1]
        cut = cuts[(before * cuts + behind * (len(rows) - cuts)).argmin()]
        waiting += [rows[cut:], rows[:cut]]
    return np.concatenate(done)


def _sizes_of_boxes(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The squared diagonals of the boxes around the first 1, 2, ... points, `(N,)`."""
    sides = np.maximum.accumulate(points) - np.minimum.accumulate(points)
    sizes: NDArray[np.float64] = (sides**2).sum(axis=1)
    return sizes


def _code_in_chunks(
    array: NDArray[np.float64], bits: tuple[int, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint32]]:
    """The smallest and largest values of each chunk, `(chunks, 3)`, as float32 has them; codes within, `(N, 3)`."""
    starts = np.arange(0, len(array), CHUNK)
    low = np.minimum.reduceat(array, starts).astype(np.float32).astype(np.float64)
    high = np.maximum.reduceat(array, starts).astype(np.float32).astype(np.float64)
    chunks = np.arange(len(array)) // CHUNK
    codes = [_code(array[:, k], low[chunks, k], high[chunks, k], bits[k]) for k in range(3)]
    return low, high, np.column_stack(codes)


def _code(values: NDArray[np.float64], low: Any, high: Any, bits: int) -> NDArray[np.uint32]:
    """The nearest of the codes 0 to 2^bits - 1, which stand for numbers evenly spread from `low` to `high`."""
    span = np.where(high > low, high - low, 1.0)
    largest = 2**bits - 1
    codes: NDArray[np.uint32] = np.rint(np.clip((values - low) / span, 0.0, 1.0) * largest).astype(np.uint32)
    return codes


def _pack_rotations(quats: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Rotations w, x, y, z of any norm as the index of the largest component and the other three, `(N,)`."""
    rows = np.arange(len(quats))
    largest = np.abs(quats).argmax(axis=1)
    norms = np.linalg.norm(quats, axis=1)
    turned = np.copysign(np.where(norms > 0, norms, 1.0), quats[rows, largest])  # the largest component is positive
    others = (np.arange(3) + (np.arange(3) >= largest[:, None])).astype(np.intp)
    kept = np.take_along_axis(quats / turned[:, None], others, axis=1)
    codes = _code(kept, -ROTATION_RANGE, ROTATION_RANGE, 10)
    return pack(np.column_stack([largest.astype(np.uint32), codes]), BITS_OF_ROTATION)


def _code_harmonics(sh_rest: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Harmonics of degree 1 and above as bytes, one colour channel after the other, without bands of zeros at the end.

    The harmonics of most fits are smaller than a step from code to code. If each was rounded to the nearest, all would
    be wrong in the same direction, and a pixel adds up many Gaussians. So it is the sum over the Gaussians so far that
    is rounded: the errors of neighbours cancel. The phases keep those of one Gaussian apart.
    """
    used = np.flatnonzero(sh_rest.any(axis=(0, 2)))
    bands = next(size - 1 for size in SH_SIZES if size - 1 > (used[-1] if len(used) else -1))
    rows = sh_rest[:, :bands].transpose(0, 2, 1).reshape(len(sh_rest), 3 * bands)
    exact = (np.clip(rows / SH_RANGE, -1.0, 1.0) + 1.0) / 2.0 * 255.0
    phases = np.arange(3 * bands) * _GOLDEN % 1.0
    codes = np.diff(np.floor(np.cumsum(exact, axis=0) + phases), axis=0, prepend=0.0)
    return np.clip(codes, 0.0, 255.0).astype(np.uint8)  # a rounding error of the sum may add one
