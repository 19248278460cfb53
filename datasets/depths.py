"""Depth maps of photos, as networks and sensors make them: found by their names, read as they are.

What the values mean, depths or inverse depths up to scale and shift, the files do not say:
:mod:`kgs.init_points.depth_maps` finds out.
"""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kgs._support.errors import DataError, cause_of, listed

from .image_file import Image, read_bytes
from .images import Maps
from .masks import fitting

SUFFIXES = (".npy", ".png", ".tif", ".tiff")
_ASPECT = 0.03  # by which the ratio of sides may be another than the photo's: networks round them to 14 or 32 pixels


def find_depths(photos: Sequence[Path], folder: Path) -> dict[Path, Path]:
    """The depth maps of photos, by photo: the files that have a photo's stem or whole name before their ending.

    Raises:
        DataError: the folder does not exist, none of its files fits a photo, one fits several photos, or two fit one.
    """
    if not folder.is_dir():
        raise DataError(folder, "", "a folder of depth maps", "no such folder")
    files = [path for path in sorted(folder.rglob("*")) if path.suffix.lower() in SUFFIXES and path.name[0] != "."]
    maps = dict[Path, Path]()
    for file, photo in fitting(folder, files, photos, "depth map").items():
        if photo in maps:
            raise DataError(file, "", f"one depth map of {photo.name}", f"{maps[photo]} too")
        maps[photo] = file
    if not maps:
        got = listed([path.relative_to(folder) for path in files]) or "nothing"
        raise DataError(folder, "", f"{', '.join(SUFFIXES)} with the stems or names of photos", got)
    return maps


def read_depths(path: Path, photo: Path, width: int, height: int) -> Image:
    """The values of a depth map, as `(height, width)` as its photo is stored; 0 where the depth is unknown.

    Raises:
        DataError: the file cannot be read, has colours instead of depths, or another shape than the photo.
    """
    values = np.squeeze(_read(path))
    if values.ndim == 3 and values.shape[2] in (3, 4) and (values[..., :3] == values[..., :1]).all():
        values = values[..., 0]  # grey, written as a colour
    if values.ndim != 2 or values.dtype.kind not in "uif":
        expected = "a depth map (H, W) of numbers"
        got = f"{values.dtype} {values.shape}"
        raise DataError(path, "", expected, got, advice="a picture that shows depths in colours has lost them")
    rows, columns = values.shape
    if not abs(columns * height / (max(rows, 1) * width) - 1) <= _ASPECT:
        raise DataError(path, "", f"the shape of {photo.name}, {width}x{height}", f"{columns}x{rows}")
    with np.errstate(over="ignore"):
        values = values.astype(np.float32)
    return resized(np.where(np.isfinite(values), values, np.float32(0)), width, height)


def resized(values: Image, width: int, height: int) -> Image:
    """A depth map of another size. Each value is one of the map's: a mean over an edge is the depth of nothing."""
    return np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST_EXACT), np.float32)


def rectified(values: Image, maps: Maps | None) -> Image:
    """A depth map whose pixels are taken from their positions in the maps, as those of its photo are; 0 outside."""
    return values if maps is None else np.asarray(cv2.remap(values, *maps, cv2.INTER_NEAREST), np.float32)


def _read(path: Path) -> NDArray[Any]:
    """The numbers of a file as they are."""
    data = read_bytes(path)
    try:
        if path.suffix.lower() == ".npy":
            return np.asarray(np.load(BytesIO(data), allow_pickle=False))
        values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except Exception as error:  # neither NumPy nor OpenCV has one class of errors for damage
        raise DataError(path, "", "a depth map", "a damaged file", advice=cause_of(error)) from error
    if values is None:
        raise DataError(path, "", "a depth map", "a damaged file")
    return np.asarray(values)
