"""Splats as PLY files in the layout of 3D Gaussian Splatting, which every viewer reads.

Source: the PLY format (G. Turk, 1994) and the vertex properties of B. Kerbl et al., "3D Gaussian Splatting", 2023:
x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3. Scales are logarithms, opacities logits, rot is
w x y z, and f_rest runs through one colour channel after the other.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .errors import DataError
from .model import GaussianModel
from .types import SH_SIZES

__all__ = ["load_ply", "save_ply"]

MAX_HEADER = 1 << 16
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_SPACE, _PART = re.compile(rb"\s"), 1 << 16
SCALARS = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


def save_ply(path: str | os.PathLike[str], model: GaussianModel, offset: Tensor | None = None) -> None:
    """Write a model as a 3DGS PLY file, all harmonics included; the file appears whole or not at all.

    The layout knows float32 only: a float32 model without offset comes back from :func:`load_ply` bit for bit, float64
    values are rounded to the nearest float32. The active degree goes into a comment.

    Args:
        path: the file to write; its folder exists.
        model: the Gaussians.
        offset: added in float64 to the means on the way out, `(3,)`; the `offset` of a Scene.

    Raises:
        ValueError: `offset` has another shape, or a value is not finite in float32.
    """
    means = model.means.detach().cpu()
    if offset is not None:
        if tuple(offset.shape) != (3,):
            raise ValueError(f"offset: expected shape (3,), got {tuple(offset.shape)}")
        means = means.double() + offset.detach().cpu().double()
    n = len(model)
    columns = torch.cat(
        [
            means.float(),
            torch.zeros(n, 3),
            model.sh_dc.detach().cpu().float().reshape(n, 3),
            model.sh_rest.detach().cpu().float().mT.flatten(1),
            model.opacity_logits.detach().cpu().float()[:, None],
            model.log_scales.detach().cpu().float(),
            model.quats.detach().cpu().float(),
        ],
        dim=1,
    )
    names = [*"xyz", "nx", "ny", "nz", *_splat_names(model.sh_rest.shape[1])]
    bad = (~torch.isfinite(columns)).any(dim=0).nonzero().flatten().tolist()
    if bad:
        raise ValueError(f"model: expected values that are finite in float32, got others in {names[bad[0]]}")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment kgs sh_degree {model.sh_degree}",
        f"element vertex {n}",
        *(f"property float {name}" for name in names),
        "end_header\n",
    ]
    path = Path(path)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(unfinished, "wb") as file:
            file.write("\n".join(header).encode("ascii"))
            file.write(columns.numpy().astype("<f4").tobytes())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def load_ply(path: str | os.PathLike[str]) -> GaussianModel:
    """Read a 3DGS PLY file: ascii or binary, properties in any order and of any scalar type, harmonics of degree 0-3.

    Properties and elements that are not those of a splat are skipped. The active degree is the one that kgs wrote
    down, else that of the harmonics in the file.

    Args:
        path: the file to read.

    Returns:
        A float32 model on the CPU.

    Raises:
        DataError: the file cannot be read or is no 3DGS PLY: wrong header, a property missing, fewer or more bytes
            than the header says, or a value that is not finite.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file:
            header = _read_header(path, file)
            body = file.read()
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error

    vertices = [element for element in header.elements if element.name == "vertex"]
    if len(vertices) != 1:
        raise DataError(path, "vertex", f"expected one element of that name, got {len(vertices)}")
    rest = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in vertices[0].properties)
    sizes = [3 * (k - 1) for k in SH_SIZES]
    if rest not in sizes:
        raise DataError(path, "f_rest", f"expected {sizes} properties of that name, got {rest}")
    names = [*"xyz", *_splat_names(rest // 3)]
    for name in names:
        if name not in vertices[0].properties:
            raise DataError(path, name, "expected this property of a splat, got none")

    columns = _read_columns(path, header, vertices[0], body)
    with np.errstate(over="ignore"):
        table = np.stack([columns[name].astype(np.float32) for name in names], axis=1)
    bad = np.argwhere(~np.isfinite(table))
    if len(bad):
        row, column = bad[0]
        raise DataError(path, names[column], f"expected finite float32 values, got {table[row, column]} in row {row}")

    n, degree = len(table), sizes.index(rest)
    means, dc, sh_rest, opacity, scales, quats = torch.from_numpy(table).split([3, 3, rest, 1, 3, 4], dim=1)
    return GaussianModel(
        means=means,
        quats=quats,
        log_scales=scales,
        opacity_logits=opacity[:, 0],
        sh_dc=dc.reshape(n, 1, 3),
        sh_rest=sh_rest.reshape(n, 3, rest // 3).mT,
        sh_degree=degree if header.sh_degree is None else min(header.sh_degree, degree),
    )


@dataclass
class _Element:
    name: str
    count: int
    properties: dict[str, str]  # name to numpy type code
    has_list: bool = False

    def dtype(self, order: str) -> np.dtype[np.void]:
        return np.dtype([(name, BYTE_ORDERS[order] + code) for name, code in self.properties.items()])

    def width(self, order: str) -> int:
        """How many bytes, or words of text, one of it takes."""
        return len(self.properties) if order == "ascii" else self.dtype(order).itemsize


@dataclass
class _Header:
    order: str
    elements: list[_Element]
    sh_degree: int | None


def _splat_names(rest: int) -> list[str]:
    """The properties after the position and normal, for so many harmonics above degree 0."""
    return [
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * rest)),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]


def _read_header(path: Path, file: BinaryIO) -> _Header:
    if file.readline(8).rstrip(b"\r\n") != b"ply":
        raise DataError(path, "", "not a PLY file: expected 'ply' in the first line")
    order, elements, degree = None, list[_Element](), None
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
                elements.append(_Element(name, int(digits), {}))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_list = True
            case ["property", kind, name] if elements and kind in SCALARS and name not in elements[-1].properties:
                elements[-1].properties[name] = SCALARS[kind]
            case ["comment", "kgs", "sh_degree", digits] if re.fullmatch("[0-9]", digits):
                degree = int(digits)
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                text = line[:80].decode("ascii", "backslashreplace").rstrip()
                raise DataError(path, "header", f"expected a line of a PLY header, got {text!r}")
    if order is None:
        raise DataError(path, "format", f"expected one of {sorted(BYTE_ORDERS)}, got none")
    return _Header(order, elements, degree)


def _read_columns(path: Path, header: _Header, vertex: _Element, body: bytes) -> dict[str, NDArray[np.generic]]:
    """The vertices' properties, after a check that the body is as long as the header says."""
    before = header.elements[: header.elements.index(vertex)]
    if vertex.has_list or any(element.has_list for element in before):
        raise DataError(path, "vertex", "expected no list property in it or before it, got one")
    available = len(body) if header.order != "ascii" else sum(map(len, _words(body)))
    start = sum(element.count * element.width(header.order) for element in before)
    end = start + vertex.count * vertex.width(header.order)
    rest = header.elements[len(before) + 1 :]
    total = end + sum(element.count * element.width(header.order) for element in rest)
    if available < end or (available != total and not any(element.has_list for element in rest)):
        unit = "numbers" if header.order == "ascii" else "bytes"
        raise DataError(path, "vertex", f"expected {total} {unit} after the header, got {available}")
    if header.order == "ascii":
        table = _numbers(path, body, start, end).reshape(vertex.count, len(vertex.properties))
        return dict(zip(vertex.properties, table.T, strict=True))
    rows = np.ndarray(vertex.count, vertex.dtype(header.order), buffer=body, offset=start)
    return {name: rows[name] for name in vertex.properties}


def _words(body: bytes) -> Iterator[list[bytes]]:
    """The words of a text, a part at a time: a list of all would take many times the memory of the text."""
    begin = 0
    while begin < len(body):
        match = _SPACE.search(body, begin + _PART)
        end = match.start() if match else len(body)
        yield body[begin:end].split()
        begin = end


def _numbers(path: Path, body: bytes, start: int, end: int) -> NDArray[np.float32]:
    """The words from `start` to `end` as numbers."""
    numbers, at = np.empty(end - start, np.float32), 0
    for words in _words(body):
        first, last = max(start, at), min(end, at + len(words))
        try:
            with np.errstate(over="ignore"):
                if first < last:
                    numbers[first - start : last - start] = [float(word) for word in words[first - at : last - at]]
        except ValueError as error:
            raise DataError(path, "vertex", str(error)[:200]) from error
        at += len(words)
    return numbers
