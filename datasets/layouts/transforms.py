"""The `transforms.json` files of NeRF's Blender scenes, instant-ngp and nerfstudio: strict reading, field by field."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, TypeGuard

import kornia.geometry as kg
import torch
from torch import Tensor

from kgs.errors import DataError
from kgs.json_files import read_json

__all__ = ["opencv_pose", "read_focal", "read_frames", "read_number", "read_text"]


def read_frames(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Read such a file.

    Returns:
        The whole object, and its list of frames, not empty.

    Raises:
        DataError: the file cannot be read, see :func:`kgs.json_files.read_json`, or has no list of frames.
    """
    data = read_json(path)
    frames = data.get("frames")
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


def read_focal(path: Path, width: float, *objects: dict[str, Any]) -> float:
    """The focal length in pixels that `camera_angle_x`, the horizontal field of view, gives images of a width.

    Raises:
        DataError: there is no angle between 0 and pi.
    """
    angle = read_number(path, "camera_angle_x", *objects)
    if not 0 < angle / 2 < math.pi / 2:
        raise DataError(path, "camera_angle_x", f"expected an angle between 0 and pi, got {angle:g}")
    return width / (2 * math.tan(angle / 2))


def opencv_pose(path: Path, frame: dict[str, Any]) -> Tensor:
    """A frame's `transform_matrix`, given with OpenGL axes, as camera-to-world with OpenCV axes, `(4, 4)` float64.

    Raises:
        DataError: it is no 4x4 matrix of finite numbers with the last row 0, 0, 0, 1, up to 1e-6 as an inverse has it.
    """
    rows, name = frame.get("transform_matrix"), f"transform_matrix of {str(frame.get('file_path'))[:200]}"
    rows = rows if isinstance(rows, list) and all(isinstance(row, list) and len(row) == 4 for row in rows) else []
    if len(rows) != 4 or not all(_is_finite(x) for row in rows for x in row):
        raise DataError(path, name, "expected a 4x4 matrix of finite numbers")
    matrix = torch.tensor([[float(x) for x in row] for row in rows], dtype=torch.float64)[None]
    last = matrix.new_tensor([0.0, 0.0, 0.0, 1.0])
    if float((matrix[0, 3] - last).abs().max()) > 1e-6:
        raise DataError(path, name, f"expected the last row 0, 0, 0, 1, got {matrix[0, 3].tolist()}")
    matrix[0, 3] = last
    return kg.camtoworld_graphics_to_vision_4x4(matrix)[0]


def _is_finite(value: Any) -> TypeGuard[float]:
    """Whether a value is a number that float64 holds; JSON's integers have no limit."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300
