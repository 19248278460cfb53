"""COLMAP's sparse models, binary and text, as plain numbers.

Source: https://colmap.github.io/format.html; rigs and frames of newer versions repeat what images.* says and are not
read. Every count is held against the file's length before anything of that size is made.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kgs.errors import DataError

__all__ = ["ColmapCamera", "ColmapImage", "find_model", "read_cameras", "read_images", "read_points"]

# Names in the order of COLMAP's model ids, with the number of parameters of those that are read.
_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
)
_PARAMETERS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
}


@dataclass(frozen=True)
class ColmapCamera:
    """A lens: the model's name, the image size, the parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """A registered photo: world-to-camera rotation as a quaternion (w, x, y, z), translation, camera id, name."""

    quat: tuple[float, ...]
    translation: tuple[float, ...]
    camera_id: int
    name: str


def find_model(root: Path) -> Path | None:
    """The folder of a scene that holds a COLMAP model, `sparse/0` or `sparse`; None where there is none."""
    for folder in (root / "sparse" / "0", root / "sparse"):
        if any((folder / f"images.{suffix}").is_file() for suffix in ("bin", "txt")):
            return folder
    return None


def model_file(folder: Path, stem: str) -> Path:
    """The binary file of that stem, else the text file.

    Raises:
        DataError: there is neither.
    """
    for suffix in ("bin", "txt"):
        if (folder / f"{stem}.{suffix}").is_file():
            return folder / f"{stem}.{suffix}"
    raise DataError(folder, "", f"expected {stem}.bin or {stem}.txt, found neither")


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Read cameras.bin or cameras.txt.

    Raises:
        DataError: the file is damaged, an id is there twice, or a camera model is not one of those that can be
            undistorted.
    """
    cameras: dict[int, ColmapCamera] = {}
    if path.suffix == ".bin":
        data = _Binary(path)
        for _ in range(data.count("number of cameras", 24)):
            camera_id, model_id, width, height = data.take("<IiQQ", "camera")
            model = _MODELS[model_id] if 0 <= model_id < len(_MODELS) else f"number {model_id}"
            params = data.take(f"<{_parameter_count(path, camera_id, model)}d", f"camera {camera_id}")
            _add(path, "camera", cameras, camera_id, ColmapCamera(model, width, height, params))
        data.finish()
    else:
        for line in _lines(path):
            if line:
                camera_id, model, width, height, *params = _fields(path, line, "iSii", "f")
                if len(params) != _parameter_count(path, camera_id, model):
                    raise DataError(path, f"camera {camera_id}", f"{len(params)} parameters do not fit {model}")
                _add(path, "camera", cameras, camera_id, ColmapCamera(model, width, height, tuple(params)))
    return cameras


def read_images(path: Path) -> dict[int, ColmapImage]:
    """Read images.bin or images.txt; the 2D observations are passed over.

    Raises:
        DataError: the file is damaged or an id is there twice.
    """
    images: dict[int, ColmapImage] = {}
    if path.suffix == ".bin":
        data = _Binary(path)
        for _ in range(data.count("number of images", 73)):
            image_id, *pose, camera_id = data.take("<I7dI", "image")
            name = data.string(f"image {image_id}")
            data.skip(24 * data.count(f"observations of {name}", 24))
            _add(path, "image", images, image_id, ColmapImage(tuple(pose[:4]), tuple(pose[4:]), camera_id, name))
        data.finish()
    else:
        lines = _lines(path)
        for line in lines:
            if line:
                image_id, *pose, camera_id, name = _fields(path, line, "ifffffffiS")
                _add(path, "image", images, image_id, ColmapImage(tuple(pose[:4]), tuple(pose[4:]), camera_id, name))
                next(lines, None)  # the observations, a line that may be empty
    return images


def read_points(path: Path, image_ids: set[int]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Read those points of points3D.bin or points3D.txt that at least two of the given images observe.

    Returns:
        Positions `(P, 3)` and RGB `(P, 3)`.

    Raises:
        DataError: the file is damaged or a position is not finite.
    """
    rows: list[tuple[Any, ...]] = []
    if path.suffix == ".bin":
        data = _Binary(path)
        for _ in range(data.count("number of points", 51)):
            _, *row, _ = data.take("<Q3d3Bd", "point")
            track = data.array("<u4", 2 * data.count("track", 8))
            if len(image_ids.intersection(track[::2].tolist())) >= 2:
                rows.append(tuple(row))
        data.finish()
    else:
        for line in _lines(path):
            if line:
                _, *row, _ = _fields(path, " ".join(line.split(maxsplit=8)[:8]), "ifffiiif")
                track = _fields(path, line.split(maxsplit=8)[8] if len(line.split(maxsplit=8)) > 8 else "", "", "i")
                if len(image_ids.intersection(track[::2])) >= 2:
                    rows.append(tuple(row))
    points = np.array([row[:3] for row in rows], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise DataError(path, "", "expected finite positions, got NaN or infinity")
    return points, np.array([row[3:] for row in rows], dtype=np.uint8).reshape(-1, 3)
