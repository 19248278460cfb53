"""COLMAP's sparse models, binary and text, as plain numbers.

Source: https://colmap.github.io/format.html. The rigs and frames of newer versions repeat what images.* says and are
not read. Every count is checked against the file's length before memory is allocated for it.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from kgs.datasets.image_file import read_bytes
from kgs.errors import DataError

T = TypeVar("T")
_LONGEST_NAME = 4096
# In the order of COLMAP's model ids: how many parameters each has, 0 for those that are not read.
_MODELS = dict(SIMPLE_PINHOLE=3, PINHOLE=4, SIMPLE_RADIAL=4, RADIAL=5, OPENCV=8, OPENCV_FISHEYE=8, FULL_OPENCV=12)
_MODELS |= dict(FOV=0, SIMPLE_RADIAL_FISHEYE=4, RADIAL_FISHEYE=5, THIN_PRISM_FISHEYE=0, RAD_TAN_THIN_PRISM_FISHEYE=0)


class ColmapCamera(NamedTuple):
    """A lens: the model's name, the image size, the parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ColmapImage(NamedTuple):
    """A registered photo: world-to-camera rotation as a quaternion (w, x, y, z), translation, camera id, name."""

    quat: tuple[float, ...]
    translation: tuple[float, ...]
    camera_id: int
    name: str


def model_file(folder: Path, stem: str) -> Path:
    """The binary file of that stem, else the text file, else a DataError."""
    for suffix in ("bin", "txt"):
        if (folder / f"{stem}.{suffix}").is_file():
            return folder / f"{stem}.{suffix}"
    raise DataError(folder, "", f"expected {stem}.bin or {stem}.txt, found neither")


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Read cameras.bin or cameras.txt; damage, a repeated id or a model without undistortion is a DataError."""
    cameras: dict[int, ColmapCamera] = {}
    if path.suffix == ".bin":
        data = _Binary(path)
        for _ in data.items("number of cameras", 24):
            camera_id, model_id, width, height = data.take("<IiQQ", "camera")
            model = dict(enumerate(_MODELS)).get(model_id, f"number {model_id}")
            params = data.take(f"<{_parameter_count(path, camera_id, model)}d", f"camera {camera_id}")
            _add(path, "camera", cameras, camera_id, ColmapCamera(model, width, height, params))
    else:
        for line in filter(None, _lines(path)):
            kinds = (int, str, int, int, partial(_numbers, float))
            camera_id, model, width, height, params = _fields(path, line, kinds)
            if len(params) != _parameter_count(path, camera_id, model):
                raise DataError(path, f"camera {camera_id}", f"{len(params)} parameters do not fit {model}")
            _add(path, "camera", cameras, camera_id, ColmapCamera(model, width, height, params))
    return cameras


def read_images(path: Path) -> dict[int, ColmapImage]:
    """Read images.bin or images.txt without the 2D observations; damage or a repeated id is a DataError."""
    images: dict[int, ColmapImage] = {}
    if path.suffix == ".bin":
        data = _Binary(path)
        for _ in data.items("number of images", 73):
            image_id, *pose, camera_id = data.take("<I7dI", "image")
            name = data.string(f"image {image_id}")
            data.take(f"{24 * data.count(f'observations of {name}', 24)}x", "observations")  # skipped
            _add(path, "image", images, image_id, ColmapImage(tuple(pose[:4]), tuple(pose[4:]), camera_id, name))
    else:
        may_be_observations = False
        for line in _lines(path):
            if not line or (may_be_observations and _is_observations(line)):
                may_be_observations = False  # an image's second line may be empty, or left out
                continue
            image_id, *pose, camera_id, name = _fields(path, line, (int, *[float] * 7, int, str))
            _add(path, "image", images, image_id, ColmapImage(tuple(pose[:4]), tuple(pose[4:]), camera_id, name))
            may_be_observations = True
    return images


def read_points(path: Path, image_ids: set[int]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Positions `(P, 3)` and RGB `(P, 3)` of the points in points3D.* that at least two of the given images observe.

    Damage, and points none of which has a track, are a DataError.
    """
    rows = []
    count = 0
    without_track = 0
    for row, track in _tracks(path):
        count += 1
        without_track += not track
        if len(image_ids.intersection(track[::2])) >= 2:
            rows.append(row)
    if 0 < count == without_track:
        wanted = "expected points with a track (the photos that observe them)"
        raise DataError(path, "", f"{wanted}, got {count} without, as LiDAR gives them: use --init file with them")
    points = np.array([row[:3] for row in rows], np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise DataError(path, "", "expected finite positions, got NaN or infinity")
    if any(not 0 <= value <= 255 for row in rows for value in row[3:]):  # integers in a text file have no limit
        raise DataError(path, "", "expected colours from 0 to 255, got others")
    return points, np.array([row[3:] for row in rows], np.uint8).reshape(-1, 3)


def _tracks(path: Path) -> Iterator[tuple[list[Any], tuple[int, ...]]]:
    """Position and colour of each point, and its track: pairs of an image's id and an observation's number."""
    if path.suffix == ".bin":
        data = _Binary(path)
        for _ in data.items("number of points", 51):
            _, *row, _ = data.take("<Q3d3Bd", "point")
            yield row, data.take(f"<{2 * data.count('track', 8)}I", "track")
    else:
        for line in filter(None, _lines(path)):
            _, *row, _, track = _fields(path, line, (int, *[float] * 3, *[int] * 3, float, partial(_numbers, int)))
            yield row, track


class _Binary:
    """A file's bytes, read in order; reading beyond their end is a DataError."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._data = read_bytes(path)
        self._at = 0

    def take(self, form: str, what: str) -> tuple[Any, ...]:
        at = self._at
        size = struct.calcsize(form)
        self._need(size, what)
        self._at += size
        return struct.unpack_from(form, self._data, at)

    def count(self, what: str, least_bytes: int) -> int:
        """The next 64-bit count, of things that take at least `least_bytes` each."""
        (number,) = self.take("<Q", what)
        self._need(number * least_bytes, what)
        return int(number)

    def items(self, what: str, least_bytes: int) -> Iterator[int]:
        """Loop as often as the next count says; after the last item the file has to end."""
        yield from range(self.count(what, least_bytes))
        if self._at != len(self._data):
            raise DataError(self._path, "", f"{len(self._data) - self._at} bytes are left over")

    def string(self, what: str) -> str:
        if (end := self._data.find(b"\0", self._at, self._at + _LONGEST_NAME)) < 0:
            raise DataError(self._path, what, "expected a name that ends with a zero byte")
        text = self._data[self._at : end]
        self._at = end + 1
        try:
            return text.decode("utf-8")
        except UnicodeDecodeError as error:
            raise DataError(self._path, what, f"expected a name in UTF-8, got {text!r}") from error

    def _need(self, size: int, what: str) -> None:
        if size > (left := len(self._data) - self._at):
            raise DataError(self._path, what, f"needs {size} bytes at byte {self._at}, the file has {left} more")


def _lines(path: Path) -> Iterator[str]:
    """The lines of a text model without its comments, stripped; empty ones included."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(path, "", "expected text in UTF-8") from error
    return (line.strip() for line in text.split("\n") if not line.startswith("#"))


def _fields(path: Path, line: str, kinds: Sequence[Callable[[str], Any]]) -> list[Any]:
    """The words of a line, converted; the last kind gets all that is left, which may be nothing."""
    words = line.split(maxsplit=len(kinds) - 1)
    try:
        return [kind(word) for kind, word in zip(kinds, (*words, "")[: len(kinds)], strict=True)]
    except ValueError as error:
        raise DataError(path, f"line {line[:60]!r}", f"expected {len(kinds)} fields as COLMAP writes them") from error


def _numbers(kind: type[T], text: str) -> tuple[T, ...]:
    return tuple(map(kind, text.split()))


def _is_observations(line: str) -> bool:
    """Whether a line can be an image's observations: x, y and a point's id, again and again."""
    words = line.split()
    try:
        return len(words) % 3 == 0 and bool([float(word) for word in words[:12]])
    except ValueError:
        return False


def _parameter_count(path: Path, camera_id: int, model: str) -> int:
    if count := _MODELS.get(model):
        return count
    known = ", ".join(name for name, count in _MODELS.items() if count)
    raise DataError(path, f"camera {camera_id}", f"camera model {model} cannot be read, only {known}")


def _add(path: Path, what: str, table: dict[int, T], key: int, value: T) -> None:
    if key in table:
        raise DataError(path, f"{what} {key}", "occurs twice")
    table[key] = value
