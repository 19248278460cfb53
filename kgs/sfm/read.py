"""Photos as a phone wrote them, made ready: decoded, turned upright, of one size, and what is known of the lens."""

import hashlib
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kgs.datasets.images import Intrinsics, read_bytes, read_image, read_size
from kgs.errors import DataError
from kgs.io.console import Stage

from .exif import FILM_DIAGONAL, Exif, read_exif, turn
from .find import CONVERT, listed
from .heic import can_read_heic, is_heic, open_heic

LONGEST = 1600  # pixels of the longer side, for matching and for what is written
_SAME_ZOOM = 1.1  # ratio of focal lengths that one lens may have
_BLURRED = 0.5  # of the median sharpness


@dataclass(frozen=True, eq=False)
class Photo:
    """One photo, upright and reduced."""

    path: Path
    exif: Exif
    pixels: NDArray[np.uint8]  # `(H, W, 3)` RGB or `(H, W, 4)` RGBA, not premultiplied

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.pixels.shape[:2]
        return width, height

    @property
    def focal(self) -> float | None:
        """The focal length in pixels as the file says, None where it does not."""
        ratio = self.exif.focal_ratio(*self.size)
        return ratio * max(self.size) if ratio else None

    def grey(self) -> NDArray[np.uint8]:
        """Brightness `(H, W)`, black where the photo is transparent."""
        rgb = self.pixels[..., :3]
        if self.pixels.shape[2] == 4:
            rgb = (rgb * (self.pixels[..., 3:] / 255.0)).round().astype(np.uint8)
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY), np.uint8)


def hash_photos(paths: list[Path]) -> dict[str, str]:
    """SHA-256 of each file by its name; a DataError where two files are one photo."""
    names: dict[str, str] = {}
    for path in paths:
        digest = hashlib.sha256(read_bytes(path)).hexdigest()
        if digest in names:
            reason = f"is the same photo as {names[digest]}: remove one of them. A second look needs a second place"
            raise DataError(path, "", reason)
        names[digest] = path.name
    return {name: digest for digest, name in names.items()}


def read_photos(paths: list[Path], stage: Stage) -> list[Photo]:
    """Read photos, turn them as their Exif says, and reduce them to the size of the smallest or to 1600 pixels.

    Raises:
        DataError: a photo cannot be read, the photos have several shapes, or were taken at several focal lengths.
    """
    metadata, sizes = [], []
    for path in paths:
        exif, size, read = _open(path)
        metadata.append((exif, read))
        sizes.append(size)
    _check_shapes(paths, sizes)
    width, height = min(sizes)
    scale = min(1.0, LONGEST / max(width, height))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    _check_lenses(paths, [exif.focal_ratio(*size) for exif, _ in metadata], size)
    photos = []
    for path, (exif, read) in stage(list(zip(paths, metadata, strict=True)), "photos", "photo"):
        image, stored = read(), size[::-1] if exif.orientation > 4 else size
        if image.shape[1::-1] != stored:
            image = np.asarray(cv2.resize(image, stored, interpolation=cv2.INTER_AREA), np.float32)
        upright = turn((image.clip(0, 1) * 255).round().astype(np.uint8), exif.orientation)
        photos.append(Photo(path, exif, np.ascontiguousarray(upright)))
    return photos


def _open(path: Path) -> tuple[Exif, tuple[int, int], Callable[[], NDArray[np.float32]]]:
    """What a photo says of its lens, its width and height when it is upright, and what reads its pixels as stored."""
    data = read_bytes(path)
    if is_heic(data) and can_read_heic():
        return open_heic(path, data)
    if data[4:8] == b"ftyp":
        raise DataError(path, "", f"is a HEIC photo or a video under another name. {CONVERT}")
    exif, (width, height) = read_exif(data), read_size(path)
    return exif, (height, width) if exif.orientation > 4 else (width, height), partial(read_image, path)


def upright_size(path: Path) -> tuple[int, int]:
    """Width and height of a photo when it is upright, not decoded; a DataError where it cannot be read."""
    return _open(path)[1]


def blurred(photos: list[Photo]) -> list[Photo]:
    """Photos that have far less fine detail than the others."""
    sharpness = np.array([_sharpness(photo.grey()) for photo in photos])
    return [photo for photo, value in zip(photos, sharpness, strict=True) if value < _BLURRED * np.median(sharpness)]


def _sharpness(grey: NDArray[np.uint8]) -> float:
    """How much of the contrast is between neighbouring pixels: standard deviations of Laplacian over brightness."""
    values = grey.astype(np.float32)
    return float(cv2.Laplacian(values, cv2.CV_32F).std() / (cv2.GaussianBlur(values, (0, 0), 4.0).std() + 1.0))


def _check_shapes(paths: list[Path], sizes: list[tuple[int, int]]) -> None:
    groups: dict[tuple[int, int], list[Path]] = defaultdict(list)
    for path, (width, height) in zip(paths, sizes, strict=True):
        known = (size for size in groups if Intrinsics(*size, 1, 1, 0, 0).same_aspect(width, height))
        groups[next(known, (width, height))].append(path)
    if len(groups) > 1:
        shapes = "; ".join(f"{width}x{height}: {listed(group)}" for (width, height), group in groups.items())
        reason = f"expected photos of one shape, got {len(groups)} ({shapes}). Keep one group in the folder"
        if any(size[::-1] in groups for size in groups):
            reason += ", or take all upright or all lying: cameras of both cannot share one lens yet"
        raise DataError(paths[0].parent, "", f"{reason}. Cropped photos do not fit those that are whole")


def _check_lenses(paths: list[Path], ratios: list[float | None], size: tuple[int, int]) -> None:
    known = sorted((ratio, path) for ratio, path in zip(ratios, paths, strict=True) if ratio)
    if known and known[-1][0] > _SAME_ZOOM * known[0][0]:
        to_film = FILM_DIAGONAL * max(size) / float(np.hypot(*size))
        lenses: dict[int, list[Path]] = defaultdict(list)
        for ratio, path in known:
            lenses[round(ratio * to_film)].append(path)
        groups = "; ".join(f"{film} mm: {listed(group)}" for film, group in lenses.items())
        reason = f"expected photos of one focal length, got {len(lenses)} (as on 35 mm film, {groups})"
        raise DataError(paths[0].parent, "", f"{reason}. Take all with one lens and without zoom")
