"""Splats as PLY files in the layout of 3D Gaussian Splatting, which every viewer reads.

Source: the PLY format (G. Turk, 1994) and the vertex properties of B. Kerbl et al., "3D Gaussian Splatting", 2023:
x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3. Scales are logarithms, opacities logits, rot is
w x y z, and f_rest runs through one colour channel after the other.
"""

import os
import re
import warnings
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kgs.errors import DataError
from kgs.model import GaussianModel
from kgs.types import SH_SIZES, check_kind

from .json_files import write_whole

MAX_HEADER = 1 << 16
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
SCALARS = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


def save_ply(path: str | os.PathLike[str], model: GaussianModel, offset: Tensor | None = None) -> None:
    """Write a model as a 3DGS PLY file, all harmonics included; the file appears whole or not at all.

    Values are float32, as viewers expect: a float32 model without offset comes back from :func:`load_ply` bit for bit.
    Where float32 would move more than a tenth of the Gaussians by more than a thousandth of their largest axis (a scene
    in map coordinates, millions of metres from its origin) x, y and z are doubles. A viewer that reads floats alone
    cannot show such a scene: write it without the offset. The active degree is a comment.

    Args:
        path: the file to write, or a link to it; its folder exists.
        model: the Gaussians.
        offset: added in float64 to the means on the way out, `(3,)`; the `offset` of a Scene.

    Raises:
        TypeError: `model` is not a GaussianModel.
        ValueError: `offset` has another shape, or a value is not finite in float32.
    """
    check_kind("model", model, GaussianModel)
    values = {name: parameter.detach().cpu().numpy() for name, parameter in model.named_parameters()}
    n, means = len(model), values["means"].astype(np.float64)
    if offset is not None:  # not + 0: that would lose the sign of zero
        means += as_vector("offset", offset)
    rest = values["sh_rest"].transpose(0, 2, 1).reshape(n, 3 * model.sh_rest.shape[1])
    parts = [means, np.zeros((n, 3)), values["sh_dc"][:, 0], rest, values["opacity_logits"][:, None]]
    with np.errstate(over="ignore"):
        columns = np.hstack([*parts, values["log_scales"], values["quats"]], dtype="<f4", casting="unsafe")
    names = [*"xyz", "nx", "ny", "nz", *_splat_names(rest.shape[1])]
    bad = np.flatnonzero(~np.isfinite(columns).all(axis=0))
    if len(bad):
        raise ValueError(f"model: expected values that are finite in float32, got others in {names[bad[0]]}")
    position = "float"
    if _float32_moves(means, values["log_scales"]):
        position, columns = "double", np.hstack([means.astype("<f8").view("<f4"), columns[:, 3:]])
    header = "ply\nformat binary_little_endian 1.0\n"
    header += f"comment kgs sh_degree {model.sh_degree}\nelement vertex {n}\n"
    header += "".join(f"property {position if name in 'xyz' else 'float'} {name}\n" for name in names) + "end_header\n"
    write_whole(Path(path), header.encode("ascii") + columns.tobytes())


def load_ply(path: str | os.PathLike[str], origin: Tensor | None = None) -> GaussianModel:
    """Read a 3DGS PLY file: ascii or binary, properties in any order and of any scalar type, harmonics of degree 0-3.

    Other properties and elements are skipped. The active degree is the one that kgs wrote down, else that of the
    harmonics in the file. Warns where float32 cannot hold the positions and `origin` would help.

    Args:
        path: the file to read.
        origin: subtracted in float64 before the positions are rounded, `(3,)`: the `offset` of :func:`save_ply`.

    Returns:
        A float32 model on the CPU.

    Raises:
        DataError: the file cannot be read, its header is wrong, a property is missing, the number of bytes is not what
            the header says, or a value is not finite.
        ValueError: `origin` has another shape or is not finite.
    """
    path, start = Path(path), np.zeros(3) if origin is None else as_vector("origin", origin)
    try:
        with open(path, "rb") as file:
            order, elements, degree = _read_header(path, file)
            places = [place for place, element in enumerate(elements) if element.name == "vertex"]
            if len(places) != 1:
                raise DataError(path, "vertex", f"expected one element of that name, got {len(places)}")
            vertex = elements[places[0]]
            if "packed_position" in vertex.codes:
                raise DataError(path, "", "a compressed splat, which cannot be read: export it as plain PLY")
            rest = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in vertex.codes)
            sizes = [3 * (k - 1) for k in SH_SIZES]
            if rest not in sizes:
                raise DataError(path, "f_rest", f"expected {sizes} properties of that name, got {rest}")
            names = [*"xyz", *_splat_names(rest)]
            for name in names:
                if name not in vertex.codes:
                    raise DataError(path, name, "expected this property of a splat, got none")
            columns = _read_columns(path, order, elements, places[0], file)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise DataError(path, "vertex", f"expected as many as fit into memory, got {vertex.count}") from error
    means = np.stack([columns[name].astype(np.float64) for name in "xyz"], axis=1) - start
    with np.errstate(over="ignore"):
        table = np.stack([*means.astype(np.float32).T, *(columns[name].astype(np.float32) for name in names[3:])], 1)
    bad = np.argwhere(~np.isfinite(table))
    if len(bad):
        row, column = bad[0]
        raise DataError(path, names[column], f"expected finite float32 values, got {table[row, column]} in row {row}")
    means32, dc, sh_rest, opacity, scales, quats = torch.from_numpy(table).split([3, 3, rest, 1, 3, 4], dim=1)
    if _float32_moves(means, scales.numpy()):
        centre = ", ".join(f"{value:.0f}" for value in np.median(means, axis=0))
        warnings.warn(f"{path}: float32 moves its Gaussians; pass an origin= near them, ({centre})", stacklevel=2)
    sh_rest, degree = sh_rest.unflatten(1, (3, rest // 3)).mT, min(degree, sizes.index(rest))
    return GaussianModel(means32, quats, scales, opacity[:, 0], dc[:, None], sh_rest, degree)


def as_vector(name: str, value: Tensor) -> NDArray[np.float64]:
    """Three finite numbers in float64; a ValueError with the argument's name if they are not."""
    vector: NDArray[np.float64] = torch.as_tensor(value, dtype=torch.float64, device="cpu").detach().numpy()
    if vector.shape != (3,):
        raise ValueError(f"{name}: expected shape (3,), got {vector.shape}")
    if not np.isfinite(vector).all():
        raise ValueError(f"{name}: expected finite numbers, got {vector.tolist()}")
    return vector


def _float32_moves(means: NDArray[np.float64], log_scales: NDArray[np.floating[Any]]) -> bool:
    """Whether float32 would move more than a tenth of the Gaussians by over a thousandth of their largest axis."""
    with np.errstate(over="ignore"):
        moved = np.abs(means.astype(np.float32) - means).max(axis=1)
        return bool((moved > 1e-3 * np.exp(log_scales.max(axis=1))).sum() > 0.1 * len(means))


@dataclass
class _Element:
    name: str
    count: int
    codes: dict[str, str] = field(default_factory=dict)  # NumPy's type code of each property, O for a list


def _splat_names(rest: int) -> list[str]:
    """The names of the properties after position and normal, with `rest` of them f_rest."""
    colors = [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest))]
    return [*colors, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def _read_header(path: Path, file: BinaryIO) -> tuple[str, list[_Element], int]:
    """The byte order, the elements in order, and the active degree (3 if the header has none)."""
    if file.readline(8).rstrip(b"\r\n") != b"ply":
        raise DataError(path, "", "not a PLY file: expected 'ply' in the first line")
    order, elements, degree = None, list[_Element](), 3
    while True:
        line = file.readline(MAX_HEADER)
        if not line.endswith(b"\n") or file.tell() > MAX_HEADER:
            raise DataError(path, "header", f"expected end_header within {MAX_HEADER} bytes")
        match line.decode("ascii", "replace").split():
            case ["end_header"]:
                break
            case ["format", name, "1.0"] if name in BYTE_ORDERS and order is None:
                order = name
            case ["element", name, digits] if re.fullmatch("[0-9]{1,18}", digits):
                elements.append(_Element(name, int(digits)))
            case ["property", "list", _, _, name] if elements:
                elements[-1].codes[name] = "O"
            case ["property", kind, name] if elements and kind in SCALARS and name not in elements[-1].codes:
                elements[-1].codes[name] = SCALARS[kind]
            case ["comment", "kgs", "sh_degree", digits] if re.fullmatch("[0-9]", digits):
                degree = int(digits)
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                text = line[:80].decode("ascii", "backslashreplace").rstrip()
                raise DataError(path, "header", f"expected a line of a PLY header, got {text!r}")
    if order is None:
        raise DataError(path, "format", f"expected one of {sorted(BYTE_ORDERS)}, got none")
    return order, elements, degree


def _read_columns(
    path: Path, order: str, elements: list[_Element], place: int, file: BinaryIO
) -> dict[str, NDArray[np.generic]]:
    """The properties of the element at `place`; binary data are read only if the file is long enough."""
    vertex, is_text, begin = elements[place], order == "ascii", file.tell()
    dtypes = [np.dtype([(name, BYTE_ORDERS[order] + code) for name, code in e.codes.items()]) for e in elements]
    if any(dtype.hasobject for dtype in dtypes[: place + 1]):
        raise DataError(path, "vertex", "expected no list property in it or before it, got one")
    widths = [len(dtype.names or ()) if is_text else dtype.itemsize for dtype in dtypes]
    ends = [0, *accumulate(element.count * width for element, width in zip(elements, widths, strict=True))]
    start, end, total = ends[place], ends[place + 1], ends[-1]
    available = os.fstat(file.fileno()).st_size - begin
    if is_text:
        with warnings.catch_warnings(action="error"):
            try:
                numbers = np.fromfile(file, np.float64, sep=" ") if total else np.empty(0)
            except (DeprecationWarning, ValueError) as error:
                raise DataError(path, "vertex", "expected nothing but numbers after the header") from error
        available = len(numbers)
    if available < end or (available != total and not any(dtype.hasobject for dtype in dtypes)):
        unit = "numbers" if is_text else "bytes"
        raise DataError(path, "vertex", f"expected {total} {unit} after the header, got {available}")
    if is_text:
        return dict(zip(vertex.codes, numbers[start:end].reshape(vertex.count, widths[place]).T, strict=True))
    file.seek(begin + start)
    rows = np.fromfile(file, dtypes[place], vertex.count)
    return {name: rows[name] for name in vertex.codes}
