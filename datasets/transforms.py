"""The `transforms.json` files of NeRF's Blender scenes, instant-ngp and nerfstudio: strict reading, field by field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn, TypeGuard

import kornia.geometry as kg
import torch
from torch import Tensor

from kgs.errors import DataError

__all__ = ["opencv_pose", "read_frames", "read_number", "read_text"]

_MOST_BYTES = 256 * 2**20


def read_frames(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Read such a file.

    Returns:
        The whole object, and its list of frames, not empty.

    Raises:
        DataError: the file is missing, too large, no JSON (NaN and Infinity are none), or has no list of frames.
    """

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is not a number of JSON")

    try:
        if path.stat().st_size > _MOST_BYTES:
            raise DataError(path, "", f"is larger than {_MOST_BYTES // 2**20} MiB")
        data = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    except OSError as error:
        raise DataError(path, "", f"cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise DataError(path, "", f"is no JSON that can be read ({error})") from error
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise DataError(path, "frames", "expected a list of objects, not empty")
    return data, frames


def read_number(path: Path, key: str, *objects: dict[str, Any], default: float | None = None) -> float:
    """The number under a key in the first of the objects that has it.

    Raises:
        DataError: it is no finite number, or is nowhere and has no default.
    """
    value = next((item[key] for item in objects if key in item), default)
    if not _is_finite(value):
        raise DataError(path, key, "expected a finite number, got " + ("none" if value is None else repr(value)[:60]))
    return float(value)


def read_text(path: Path, key: str, *objects: dict[str, Any], default: str | None = None) -> str:
    """The text under a key in the first of the objects that has it.

    Raises:
        DataError: it is no text, or is nowhere and has no default.
    """
    value = next((item[key] for item in objects if key in item), default)
    if not isinstance(value, str):
        raise DataError(path, key, "expected a text, got " + ("none" if value is None else repr(value)[:60]))
    return value


def opencv_pose(path: Path, frame: dict[str, Any]) -> Tensor:
    """A frame's `transform_matrix`, given with OpenGL axes, as camera-to-world with OpenCV axes, `(4, 4)` float64.

    Raises:
        DataError: it is no 4x4 matrix of finite numbers with the last row 0, 0, 0, 1.
    """
    rows, name = frame.get("transform_matrix"), f"transform_matrix of {frame.get('file_path')}"
    numbers = [x for row in rows if isinstance(row, list) for x in row] if isinstance(rows, list) else []
    if len(numbers) != 16 or len(rows or ()) != 4 or not all(_is_finite(x) for x in numbers):
        raise DataError(path, name, "expected a 4x4 matrix of finite numbers")
    matrix = torch.tensor(numbers, dtype=torch.float64).reshape(1, 4, 4)
    if matrix[0, 3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise DataError(path, name, f"expected the last row 0, 0, 0, 1, got {numbers[12:]}")
    return kg.camtoworld_graphics_to_vision_4x4(matrix)[0]


def _is_finite(value: Any) -> TypeGuard[float]:
    """Whether a value is a number that float64 holds; JSON's integers have no limit."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300
