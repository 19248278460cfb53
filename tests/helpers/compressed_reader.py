"""Reads compressed PLY files number by number, as PlayCanvas describes the layout and its engine reads it."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from kgs import GaussianModel

_SIZES = {"float": 4, "uint": 4, "uchar": 1}


def header(path: Path) -> tuple[list[str], bytes]:
    """The lines of the header, and the bytes behind it."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    return head.decode("ascii").splitlines(), body


def decode(path: Path) -> dict[str, NDArray[np.float64]]:
    """The values of the file by the names of a model's parameters, in the order of the file; opacities as they are."""
    lines, body = header(path)
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in lines[2:]:
        match line.split():
            case ["element", name, count]:
                elements.append((name, int(count), []))
            case ["property", kind, name]:
                elements[-1][2].append((name, kind))
            case words:
                assert words[0] == "comment"
    tables: dict[str, list[dict[str, float]]] = {}
    offset = 0
    for name, count, properties in elements:
        layout = "<" + "".join({"float": "f", "uint": "I", "uchar": "B"}[kind] for _, kind in properties)
        size = sum(_SIZES[kind] for _, kind in properties)
        rows = [struct.unpack_from(layout, body, offset + size * i) for i in range(count)]
        tables[name] = [dict(zip([each for each, _ in properties], row, strict=True)) for row in rows]
        offset += size * count
    assert offset == len(body)
    assert len(tables["chunk"]) == math.ceil(len(tables["vertex"]) / 256)
    found: dict[str, list[Any]] = {key: [] for key in ("means", "quats", "log_scales", "opacities", "sh_dc", "sh_rest")}
    for i, vertex in enumerate(tables["vertex"]):
        chunk = tables["chunk"][i // 256]
        found["means"].append(_vector(vertex["packed_position"], chunk, "xyz"))
        found["log_scales"].append(_vector(vertex["packed_scale"], chunk, ("scale_x", "scale_y", "scale_z")))
        found["quats"].append(_rotation(int(vertex["packed_rotation"])))
        color = int(vertex["packed_color"])
        rgb = [
            _between(chunk, name, (color >> shift & 255) / 255) for name, shift in zip("rgb", (24, 16, 8), strict=True)
        ]
        found["sh_dc"].append([[(value - 0.5) / 0.28209479177387814 for value in rgb]])
        found["opacities"].append((color & 255) / 255)
        if "sh" in tables:
            row = tables["sh"][i]
            bands = len(row) // 3
            coefficients = [row[f"f_rest_{k}"] * 8 / 255 - 4 for k in range(3 * bands)]
            found["sh_rest"].append([[coefficients[channel * bands + k] for channel in range(3)] for k in range(bands)])
        else:
            found["sh_rest"].append(np.zeros((0, 3)))
    return {name: np.array(rows, np.float64) for name, rows in found.items()}


def as_model(values: dict[str, NDArray[np.float64]]) -> GaussianModel:
    """A model of what was read; opacities of 0 and 1 get logits that a float32 sigmoid makes 0 and 1 again."""
    tensors = {name: torch.from_numpy(array) for name, array in values.items() if name != "opacities"}
    logits = torch.logit(torch.from_numpy(values["opacities"])).clamp(-100, 100)
    return GaussianModel(**{name: value.float() for name, value in tensors.items()}, opacity_logits=logits.float())


def _between(chunk: dict[str, float], name: str, share: float) -> float:
    return chunk[f"min_{name}"] * (1 - share) + chunk[f"max_{name}"] * share


def _vector(word: float, chunk: dict[str, float], names: Any) -> list[float]:
    """11, 10 and 11 bits, the first of them the highest."""
    bits = f"{int(word):032b}"
    parts = (bits[:11], bits[11:21], bits[21:])
    return [_between(chunk, name, int(part, 2) / (2 ** len(part) - 1)) for name, part in zip(names, parts, strict=True)]


def _rotation(word: int) -> list[float]:
    """w, x, y, z; the two highest bits name the component that is left out, the largest."""
    bits = f"{word:032b}"
    parts = [(int(bits[k : k + 10], 2) / 1023 - 0.5) * math.sqrt(2) for k in (2, 12, 22)]
    parts.insert(int(bits[:2], 2), math.sqrt(1 - sum(part**2 for part in parts)))
    return parts
