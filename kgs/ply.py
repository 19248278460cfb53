"""Splats as PLY files in the layout of 3D Gaussian Splatting, which every viewer reads.

Source: the PLY format (G. Turk, 1994) and the vertex properties of B. Kerbl et al., "3D Gaussian Splatting", 2023:
x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3. Scales are logarithms, opacities logits, rot is
w x y z, and f_rest runs through one colour channel after the other.
"""

import os
import re
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kgs import packed_ply
from kgs._support.checks import check_kind
from kgs._support.errors import ArgumentError, DataError, quoted, warn
from kgs._support.json_files import write_whole
from kgs.geometry.types import SH_SIZES
from kgs.model import MAX_SH_DEGREE, GaussianModel

MAX_HEADER = 1 << 16  # bytes
# NumPy's codes for the formats and types of PLY files.
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
SCALARS = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_REST_COUNTS = [3 * (size - 1) for size in SH_SIZES]  # properties f_rest, by degree
_PLAIN_COUNT = 14  # properties of a splat that are none of these


class Float32Warning(UserWarning):
    """Float32 cannot hold the positions of a splat, as it can relative to an origin near them."""


def save_ply(
    path: str | os.PathLike[str], model: GaussianModel, offset: Tensor | None = None, sh_degree: int | None = None
) -> None:
    """Write a model as a 3DGS PLY file with all its harmonics. The write is atomic.

    Values are float32, as viewers expect: a float32 model without offset comes back from :func:`load_ply` bit for bit.
    Positions are doubles where float32 would move more than a tenth of the Gaussians by more than a thousandth of their
    largest axis, as in map coordinates, millions of metres from the origin. Viewers that read floats only cannot show
    such a file: write it without the offset. Comments hold the active degree, and the tag of an antialiased model.

    Args:
        path: the file to write, or a link to it; its folder exists.
        model: the Gaussians.
        offset: added in float64 to the means on the way out, `(3,)`; the `offset` of a Scene.
        sh_degree: the degree of the harmonics in the file, from the model's to 3. Those that the model lacks are
            written as zeros, for programs that read files of degree 3 only. None: the model's.

    Raises:
        TypeError: `model` is not a GaussianModel.
        ValueError: `offset` has another shape, `sh_degree` is out of range, or a value is not finite in float32.
    """
    check_kind("model", model, GaussianModel)
    bands = SH_SIZES[_degree_of_file(sh_degree, model)] - 1
    values = {name: parameter.detach().cpu().numpy() for name, parameter in model.per_gaussian().items()}
    means = values["means"].astype(np.float64)
    if offset is not None:  # adding zeros instead would lose the sign of -0.0
        means += as_vector("offset", offset)
    sh_rest = np.zeros((len(model), 3, bands), values["sh_rest"].dtype)
    sh_rest[:, :, : model.sh_rest.shape[1]] = values["sh_rest"].transpose(0, 2, 1)
    parts = [
        means,
        np.zeros((len(model), 3)),  # normals
        values["sh_dc"][:, 0],
        sh_rest.reshape(len(model), 3 * bands),
        values["opacity_logits"][:, None],
        values["log_scales"],
        values["quats"],
    ]
    with np.errstate(over="ignore"):
        table = np.hstack(parts, dtype="<f4", casting="unsafe")
    names = [*"xyz", "nx", "ny", "nz", *_properties_after_normals(3 * bands)]
    invalid = _invalid(table, names).any(axis=0)
    if invalid.any():
        raise ArgumentError(
            "model", "values that are finite in float32", f"NaN or infinity in {names[invalid.argmax()]}"
        )
    position = "float"
    if float32_moves(means, values["log_scales"]):
        position = "double"
        table = np.hstack([means.astype("<f8").view("<f4"), table[:, 3:]])
    comments = [f"kgs sh_degree {model.sh_degree}"]
    if model.antialiased:
        comments.append("SplatRenderMode: mip")
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(model)}",  # the viewer of 3D Gaussian Splatting expects it in the third line
        *(f"property {position if name in 'xyz' else 'float'} {name}" for name in names),
        *(f"comment {comment}" for comment in comments),
        "end_header",
    ]
    header = "".join(f"{line}\n" for line in lines)
    write_whole(Path(path), header.encode("ascii") + table.tobytes())


def load_ply(path: str | os.PathLike[str], origin: Tensor | None = None) -> GaussianModel:
    """Read a 3DGS PLY file: ascii or binary, properties in any order and of any scalar type, harmonics of degree 0-3.

    Compressed files are read too, see :func:`kgs.save_compressed_ply`.

    Other properties and elements are skipped. The active degree is that of a comment of kgs, else that of the harmonics
    in the file. The model is antialiased if a comment says so: `SplatRenderMode: mip` (Brush, splat-transform, kgs) or
    `antialiased 1` (Postshot). Scales of -inf, those of flat discs, and opacities of inf and -inf, which are 1 and 0,
    are read as they are. Rows that are no Gaussian are left out with a warning that counts them: rotations of length 0,
    and other values that are not finite. Warns, with a Float32Warning, where an `origin` would help.

    Args:
        path: the file to read.
        origin: subtracted in float64 before the positions are rounded, `(3,)`: the `offset` of :func:`save_ply`.

    Returns:
        A float32 model on the CPU.

    Raises:
        DataError: the file cannot be read, its header is wrong, a property is missing, the number of bytes is not what
            the header says, half of the rows or more have a value that is not finite, or no row is a Gaussian (a file
            without rows is an empty model).
        ValueError: `origin` has another shape or is not finite.
    """
    path = Path(path)
    shift = np.zeros(3) if origin is None else as_vector("origin", origin)
    try:
        with open(path, "rb") as file:
            header = _read_header(path, file)
            vertex = _find(path, header, "vertex")
            if packed_ply.PACKED[0] in vertex.codes:
                columns = _read_packed(path, header, file)
                rest = len(columns) - _PLAIN_COUNT
            else:
                rest = _count_harmonics(path, vertex)
                _check_properties(path, vertex, [*"xyz", *_properties_after_normals(rest)])
                columns = _read_columns(path, header, file, vertex)
    except OSError as error:
        if path.is_dir():
            meant = f"its splat is {path / 'splat.ply'}" if (path / "splat.ply").is_file() else ""
            raise DataError(path, "", "a PLY file", "a folder", advice=meant) from error
        raise DataError(path, "", "a file that can be read", advice=error.strerror or str(error)) from error
    except MemoryError as error:
        raise DataError(path, "vertex", "as many as fit into memory", vertex.count) from error
    names = [*"xyz", *_properties_after_normals(rest)]
    means = np.stack([columns[name].astype(np.float64) for name in "xyz"], axis=1) - shift
    with np.errstate(over="ignore"):
        others = (columns[name].astype(np.float32) for name in names[3:])
        table = np.stack([*means.astype(np.float32).T, *others], axis=1)
    kept = _rows_of_gaussians(path, table, names)
    if not kept.all():
        reasons = _why_left_out(table, kept)
        if not kept.any():
            rows = "1 row that is none" if len(table) == 1 else f"{len(table)} rows that are none"
            raise DataError(path, "vertex", "at least one Gaussian", rows, advice=reasons)
        warn(f"{path}: {int((~kept).sum())} of {len(table)} Gaussians are left out: {reasons}")
        table = table[kept]
        means = means[kept]
    parts = torch.from_numpy(table).split([3, 3, rest, 1, 3, 4], dim=1)
    means32, sh_dc, sh_rest, opacity_logits, log_scales, quats = parts
    if float32_moves(means, log_scales.numpy()):
        centre = ", ".join(f"{value:.0f}" for value in np.median(means, axis=0))
        warn(f"{path}: float32 moves its Gaussians; pass an origin= near them, ({centre})", Float32Warning)
    return GaussianModel(
        means32,
        quats,
        log_scales,
        opacity_logits[:, 0],
        sh_dc[:, None],
        sh_rest.unflatten(1, (3, rest // 3)).mT,
        sh_degree=min(header.sh_degree, _REST_COUNTS.index(rest)),
        antialiased=header.antialiased,
    )


def as_vector(name: str, value: Tensor) -> NDArray[np.float64]:
    """A vector of three finite numbers as float64; a ValueError that names the argument if it is none."""
    vector: NDArray[np.float64] = torch.as_tensor(value, dtype=torch.float64, device="cpu").detach().numpy()
    if vector.shape != (3,):
        raise ArgumentError(name, "shape (3,)", vector.shape)
    if not np.isfinite(vector).all():
        raise ArgumentError(name, "finite numbers", vector.tolist())
    return vector


def _invalid(table: NDArray[np.float32], names: list[str]) -> NDArray[np.bool_]:
    """The entries that no splat can have: NaN and infinity.

    But the scale of a flat disc has the logarithm -inf, and opacities of 1 and 0 have the logits inf and -inf. `names`
    are the properties in the columns of the table.
    """
    invalid = ~np.isfinite(table)
    scales = [i for i, name in enumerate(names) if name.startswith("scale_")]
    opacity = names.index("opacity")
    invalid[:, scales] &= table[:, scales] != -np.inf
    invalid[:, opacity] = np.isnan(table[:, opacity])
    return invalid


def _rows_of_gaussians(path: Path, table: NDArray[np.float32], names: list[str]) -> NDArray[np.bool_]:
    """Which rows are Gaussians: all values are those of a splat, and the rotation, the last four, has a length, `(N,)`.

    A DataError if the values of half of the rows or more are not: then the file is damaged, or of another kind.
    """
    invalid = _invalid(table, names)
    is_valid = np.logical_not(invalid.any(axis=1))
    if 2 * int(is_valid.sum()) <= len(table) and len(table):
        row, column = np.argwhere(invalid)[0]
        raise DataError(path, names[column], "finite float32 values", f"{table[row, column]} in row {row}")
    rows: NDArray[np.bool_] = is_valid & table[:, -4:].any(axis=1)
    return rows


def _why_left_out(table: NDArray[np.float32], kept: NDArray[np.bool_]) -> str:
    """Why rows are left out, and how many for each reason."""
    without_length = int((~table[:, -4:].any(axis=1)).sum())
    not_finite = int((~kept).sum()) - without_length
    counts = ((without_length, "a rotation of length 0"), (not_finite, "values that are not finite"))
    return " and ".join(f"{count} {'has' if count == 1 else 'have'} {what}" for count, what in counts if count)


def _degree_of_file(sh_degree: int | None, model: GaussianModel) -> int:
    """The degree of the harmonics that `save_ply` writes; a ValueError if they cannot hold the model's."""
    minimum = model.max_sh_degree
    if sh_degree is None:
        return minimum
    if not isinstance(sh_degree, int | np.integer) or not minimum <= sh_degree <= MAX_SH_DEGREE:
        expected = f"an integer from {minimum}, the model's, to {MAX_SH_DEGREE}"
        raise ArgumentError("sh_degree", expected, quoted(sh_degree))
    return int(sh_degree)


def float32_moves(means: NDArray[np.float64], log_scales: NDArray[np.floating[Any]]) -> bool:
    """Whether float32 would move more than a tenth of the Gaussians by over a thousandth of their largest axis."""
    with np.errstate(over="ignore"):
        shifts = np.abs(means.astype(np.float32) - means).max(axis=1)
        largest = np.exp(log_scales.max(axis=1))
    return int((shifts > 1e-3 * largest).sum()) > 0.1 * len(means)


@dataclass
class _Element:
    """An element of a PLY file, such as "vertex": so many rows of the same properties."""

    name: str
    count: int
    codes: dict[str, str] = field(default_factory=dict)  # NumPy's type code of each property, O for a list


@dataclass
class _Header:
    """What the header of a PLY file says."""

    format: str = ""  # a key of BYTE_ORDERS
    elements: list[_Element] = field(default_factory=list)
    sh_degree: int = 3  # the active degree
    antialiased: bool = False

    def read_comment(self, comment: str) -> None:
        """Set what the comment says of the splat; of several comments the last one counts."""
        match re.split(r"[\s:]+", comment.lower()):
            case ["kgs", "sh_degree", digit] if re.fullmatch("[0-9]", digit):
                self.sh_degree = int(digit)
            case ["splatrendermode", mode]:  # default, mip or 2dgs
                self.antialiased = mode == "mip"
            case ["antialiased", flag]:  # 0 or 1
                self.antialiased = flag == "1"


def _properties_after_normals(rest: int) -> list[str]:
    """The names of a splat's properties behind positions and normals, with `rest` properties f_rest."""
    colors = [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest))]
    return [*colors, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def _find(path: Path, header: _Header, name: str) -> _Element:
    """The one element of this name."""
    found = [element for element in header.elements if element.name == name]
    if len(found) != 1:
        raise DataError(path, name, "one element of that name", len(found))
    return found[0]


def _count_harmonics(path: Path, element: _Element) -> int:
    """The number of properties f_rest."""
    count = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in element.codes)
    if count not in _REST_COUNTS:
        raise DataError(path, "f_rest", f"{_REST_COUNTS} properties of that name", count)
    return count


def _check_properties(path: Path, element: _Element, names: list[str]) -> None:
    """Raise a DataError where an element lacks a property."""
    for name in names:
        if name not in element.codes:
            raise DataError(path, name, "this property of a splat", "none")


def _read_packed(path: Path, header: _Header, file: BinaryIO) -> dict[str, NDArray[np.generic]]:
    """The properties of a compressed splat, as a plain one has them."""
    vertex = _find(path, header, "vertex")
    chunk = _find(path, header, "chunk")
    _check_properties(path, vertex, packed_ply.PACKED)
    _check_properties(path, chunk, packed_ply.BOUNDS)
    expected = -(-vertex.count // packed_ply.CHUNK)
    if chunk.count != expected:
        raise DataError(path, "chunk", f"{expected} for {vertex.count} Gaussians", chunk.count)
    harmonics: dict[str, NDArray[np.generic]] = {}
    start = file.tell()
    if any(element.name == "sh" for element in header.elements):
        sh = _find(path, header, "sh")
        _check_properties(path, sh, [f"f_rest_{i}" for i in range(_count_harmonics(path, sh))])
        if sh.count != vertex.count:
            raise DataError(path, "sh", f"{vertex.count} as vertices", sh.count)
        harmonics = _read_columns(path, header, file, sh)
        file.seek(start)
    ranges = _read_columns(path, header, file, chunk)
    file.seek(start)
    return packed_ply.unpacked(ranges, _read_columns(path, header, file, vertex), harmonics)


def _read_header(path: Path, file: BinaryIO) -> _Header:
    """Read the header; the file is then at the first byte of the data."""
    if file.readline(8).rstrip(b"\r\n") != b"ply":
        raise DataError(path, "", "a PLY file", "one without 'ply' in the first line")
    header = _Header()
    elements = header.elements
    while True:
        line = file.readline(MAX_HEADER)
        if not line.endswith(b"\n") or file.tell() > MAX_HEADER:
            raise DataError(path, "header", f"end_header within {MAX_HEADER} bytes")
        match line.decode("ascii", "replace").split():
            case ["end_header"]:
                break
            case ["format", name, "1.0"] if name in BYTE_ORDERS and not header.format:
                header.format = name
            case ["element", name, digits] if re.fullmatch("[0-9]{1,18}", digits):
                elements.append(_Element(name, int(digits)))
            case ["property", "list", _, _, name] if elements:
                elements[-1].codes[name] = "O"
            case ["property", kind, name] if elements and kind in SCALARS and name not in elements[-1].codes:
                elements[-1].codes[name] = SCALARS[kind]
            case ["comment", *words]:
                header.read_comment(" ".join(words))
            case ["obj_info", *_] | []:
                pass
            case _:
                text = line[:80].decode("ascii", "backslashreplace").rstrip()
                raise DataError(path, "header", "a line of a PLY header", quoted(text))
    if not header.format:
        raise DataError(path, "format", f"one of {sorted(BYTE_ORDERS)}", "none")
    return header


def _read_columns(path: Path, header: _Header, file: BinaryIO, element: _Element) -> dict[str, NDArray[np.generic]]:
    """The properties of an element by name, `(N,)` each; the file is at the first byte of the data.

    Binary data are read only if the file has as many bytes as the header says, so a wrong count takes no memory.
    """
    index = header.elements.index(element)
    dtypes = [_row_dtype(each, BYTE_ORDERS[header.format]) for each in header.elements]
    if any(dtype.hasobject for dtype in dtypes[: index + 1]):
        raise DataError(path, element.name, "no list property in it or before it", "one")
    is_text = header.format == "ascii"
    data_start = file.tell()
    widths = [len(dtype.names or ()) if is_text else dtype.itemsize for dtype in dtypes]
    sizes = [each.count * width for each, width in zip(header.elements, widths, strict=True)]
    start = sum(sizes[:index])
    end = start + sizes[index]
    total = sum(sizes)
    if is_text:
        numbers = _read_numbers(path, file) if total else np.empty(0)
        available = len(numbers)
    else:
        available = os.fstat(file.fileno()).st_size - data_start
    has_lists = any(dtype.hasobject for dtype in dtypes)  # behind the vertices: then the total is not known
    if available < end or (available != total and not has_lists):
        unit = "numbers" if is_text else "bytes"
        raise DataError(path, element.name, f"{total} {unit} after the header", available)
    if is_text:
        table = numbers[start:end].reshape(element.count, widths[index])
        return dict(zip(element.codes, table.T, strict=True))
    file.seek(data_start + start)
    rows = np.fromfile(file, dtypes[index], element.count)
    return {name: rows[name] for name in element.codes}


def _row_dtype(element: _Element, byte_order: str) -> np.dtype[Any]:
    """The type of one row of an element in a binary file."""
    return np.dtype([(name, byte_order + code) for name, code in element.codes.items()])


def _read_numbers(path: Path, file: BinaryIO) -> NDArray[np.float64]:
    """All numbers in the rest of a text file."""
    with warnings.catch_warnings(action="error"):
        try:
            return np.fromfile(file, np.float64, sep=" ")
        except (DeprecationWarning, ValueError) as error:
            raise DataError(path, "vertex", "nothing but numbers after the header") from error
