"""COLMAP's sparse models, binary and text, as plain numbers.

Source: https://colmap.github.io/format.html, and https://colmap.github.io/rigs.html for rigs and frames. Every count is
checked against the file's length before memory is allocated for it.
"""

import re
import struct
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from kgs._support.errors import DataError, quantity, quoted
from kgs.datasets.image_file import read_bytes

T = TypeVar("T")
STEMS = ("cameras", "images", "points3D")  # the files of a model that COLMAP needs
_LONGEST_NAME = 4096
# In the order of COLMAP's model ids: how many parameters each has, 0 for those that are not read.
_MODELS = dict(SIMPLE_PINHOLE=3, PINHOLE=4, SIMPLE_RADIAL=4, RADIAL=5, OPENCV=8, OPENCV_FISHEYE=8, FULL_OPENCV=12)
_MODELS |= dict(FOV=0, SIMPLE_RADIAL_FISHEYE=4, RADIAL_FISHEYE=5, THIN_PRISM_FISHEYE=0, RAD_TAN_THIN_PRISM_FISHEYE=0)
_MODELS |= dict(SIMPLE_DIVISION=0, DIVISION=0, SIMPLE_FISHEYE=3, FISHEYE=4, EUCM=0, EQUIRECTANGULAR=0)
_CAMERA = 0  # COLMAP's number of this kind of sensor
_SUFFIXES = ("bin", "txt")


class ColmapCamera(NamedTuple):
    """A lens: the model's name, the image size, the parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ColmapPose(NamedTuple):
    """A transformation from the world, or from a rig: rotation as a quaternion (w, x, y, z), and translation."""

    quat: tuple[float, ...]
    translation: tuple[float, ...]


_IDENTITY = ColmapPose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


class ColmapImage(NamedTuple):
    """A registered photo: its pose from world to camera, camera id, name."""

    pose: ColmapPose
    camera_id: int
    name: str


class ColmapFrame(NamedTuple):
    """What a rig saw at once: the rig's pose from the world; the photos' ids, and the camera of each."""

    rig_id: int
    pose: ColmapPose
    cameras: dict[int, int]


def model_file(folder: Path, stem: str) -> Path:
    """A file of a model: the one with that stem, of the format that COLMAP reads; a DataError if there is none.

    COLMAP reads binary files if all three are there, else text files if all three are. Where neither are, the binary
    file comes before the text file.
    """
    whole = [suffix for suffix in _SUFFIXES if all((folder / f"{stem}.{suffix}").is_file() for stem in STEMS)]
    for suffix in [*whole, *_SUFFIXES]:
        if (folder / f"{stem}.{suffix}").is_file():
            return folder / f"{stem}.{suffix}"
    raise DataError(folder, "", f"{stem}.bin or {stem}.txt", "neither")


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Read cameras.bin or cameras.txt; damage, a repeated id or a model without undistortion is a DataError."""
    cameras: dict[int, ColmapCamera] = {}
    for record in _records(path, "number of cameras", 24):
        camera_id, model, width, height = record.take("<IlQQ", "camera")
        name = model if isinstance(model, str) else dict(enumerate(_MODELS)).get(model, f"number {model}")
        params = record.take(f"<{_parameter_count(path, camera_id, name)}d", f"camera {camera_id}")
        _add(path, "camera", cameras, camera_id, ColmapCamera(name, width, height, params))
    return cameras


def read_images(path: Path) -> dict[int, ColmapImage]:
    """Read images.bin or images.txt without the 2D observations; damage or a repeated id is a DataError."""
    images: dict[int, ColmapImage] = {}
    for record in _records(path, "number of images", 73):
        image_id, *pose, camera_id = record.take("<I7dI", "image")
        name = record.string(f"image {image_id}")
        record.skip_observations(name)
        _add(path, "image", images, image_id, ColmapImage(_pose(pose), camera_id, name))
    return images


def read_rigs(path: Path) -> dict[int, dict[int, ColmapPose | None]]:
    """Read rigs.bin or rigs.txt: of each rig its cameras' poses from the rig; None: a pose that is not known.

    Damage or a repeated id is a DataError. Sensors that are no cameras are skipped.
    """
    rigs: dict[int, dict[int, ColmapPose | None]] = {}
    for record in _records(path, "number of rigs", 8):
        rig_id, count = record.take("<II", "rig")
        cameras: dict[int, ColmapPose | None] = {}
        for i in range(count):
            kind, sensor_id = record.take("<iI", f"rig {rig_id}")
            pose: ColmapPose | None = _IDENTITY  # the first sensor is where the rig is
            if i > 0:
                (is_known,) = record.take("<B", f"rig {rig_id}")
                pose = _pose(record.take("<7d", f"rig {rig_id}")) if is_known else None
            if kind == _CAMERA:
                _add(path, f"rig {rig_id}: camera", cameras, sensor_id, pose)
        _add(path, "rig", rigs, rig_id, cameras)
    return rigs


def read_frames(path: Path) -> dict[int, ColmapFrame]:
    """Read frames.bin or frames.txt without what no camera saw; damage or a repeated id is a DataError."""
    frames: dict[int, ColmapFrame] = {}
    for record in _records(path, "number of frames", 68):
        frame_id, rig_id, *pose, count = record.take("<II7dI", "frame")
        cameras: dict[int, int] = {}
        for _ in range(count):
            kind, sensor_id, data_id = record.take("<iIQ", f"frame {frame_id}")
            if kind == _CAMERA:
                _add(path, f"frame {frame_id}: image", cameras, data_id, sensor_id)
        _add(path, "frame", frames, frame_id, ColmapFrame(rig_id, _pose(pose), cameras))
    return frames


def read_points(path: Path, image_ids: set[int]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Positions `(P, 3)` and RGB `(P, 3)` of the points in points3D.* that at least two of the given images observe.

    Damage, and points none of which has a track, are a DataError.
    """
    rows = []
    count = 0
    without_track = 0
    for record in _records(path, "number of points", 51):
        _, *row, _ = record.take("<Q3d3Bd", "point")
        track = record.track()
        count += 1
        without_track += not track
        if len(image_ids.intersection(track[::2])) >= 2:
            rows.append(row)
    if 0 < count == without_track:
        got = f"{count} without, as LiDAR gives them"
        advice = "use --init file with them"
        raise DataError(path, "", "points with a track (the photos that observe them)", got, advice=advice)
    points = np.array([row[:3] for row in rows], np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise DataError(path, "", "finite positions", "NaN or infinity")
    colors = [value for row in rows for value in row[3:]]
    if not 0 <= min(colors, default=0) <= max(colors, default=0) <= 255:  # integers in a text file have no limit
        raise DataError(path, "", "colours from 0 to 255", f"{min(colors)} to {max(colors)}"[:200])
    return points, np.array([row[3:] for row in rows], np.uint8).reshape(-1, 3)


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

    def count(self, what: str, min_bytes: int) -> int:
        """The next 64-bit count, of things that take at least `min_bytes` each."""
        (number,) = self.take("<Q", what)
        self._need(number * min_bytes, what)
        return int(number)

    def items(self, what: str, min_bytes: int) -> Iterator[int]:
        """Loop as often as the next count says; after the last item the file has to end."""
        yield from range(self.count(what, min_bytes))
        if self._at != len(self._data):
            raise DataError(self._path, "", f"{self._at} bytes", len(self._data))

    def string(self, what: str) -> str:
        if (end := self._data.find(b"\0", self._at, self._at + _LONGEST_NAME)) < 0:
            raise DataError(self._path, what, "a name that ends with a zero byte")
        text = self._data[self._at : end]
        self._at = end + 1
        try:
            return text.decode("utf-8")
        except UnicodeDecodeError as error:
            raise DataError(self._path, what, "a name in UTF-8", quoted(text)) from error

    def skip_observations(self, name: str) -> None:
        self.take(f"{24 * self.count(f'observations of {name}', 24)}x", "observations")

    def track(self) -> tuple[int, ...]:
        """Pairs of an image's id and an observation's number."""
        return self.take(f"<{2 * self.count('track', 8)}I", "track")

    def _need(self, size: int, what: str) -> None:
        if size > (left := len(self._data) - self._at):
            raise DataError(self._path, what, f"{size} bytes at byte {self._at}", left)


# What words of a text stand for, by the code that their numbers have in a binary file. Of a camera's model it is "l".
_WORDS: dict[str, Callable[[str], Any]] = {
    "i": lambda word: _CAMERA if word == "CAMERA" else -1,
    "l": str,
    **dict.fromkeys("IQB", int),
    "d": float,
}


class _Line:
    """A line of a text model, which is read as `_Binary` is."""

    def __init__(self, path: Path, line: str) -> None:
        self._path = path
        self._line = line
        self._left = line

    def take(self, form: str, what: str) -> tuple[Any, ...]:
        codes = _codes(form)
        *words, self._left = [*self._left.split(maxsplit=len(codes)), ""][: len(codes) + 1]
        try:
            return tuple(_WORDS[code](word) for code, word in zip(codes, words, strict=True))
        except ValueError as error:
            raise DataError(self._path, what, "a line as COLMAP writes it", quoted(self._line)) from error

    def string(self, _: str) -> str:
        text, self._left = self._left, ""
        return text

    def skip_observations(self, name: str) -> None:
        """They are in another line."""

    def track(self) -> tuple[int, ...]:
        return self.take(f"{len(self._left.split())}I", "track")

    def end(self) -> None:
        """The line has to end here."""
        if self._left:
            more = quantity(len(self._left.split()), "more word")
            raise DataError(self._path, f"line {quoted(self._line)}", "its end", more)


@cache
def _codes(form: str) -> str:
    """The code of each number of a struct's format."""
    return "".join(code * int(count or 1) for count, code in re.findall(r"(\d*)([a-zA-Z])", form))


def _records(path: Path, what: str, min_bytes: int) -> Iterator[_Binary | _Line]:
    """Of each of a file's records what reads it: the file's bytes, or a line."""
    if path.suffix == ".bin":
        data = _Binary(path)
        for _ in data.items(what, min_bytes):
            yield data
    else:
        for text in _lines(path):
            line = _Line(path, text)
            yield line
            line.end()


def _pose(numbers: Sequence[float]) -> ColmapPose:
    """A pose of seven numbers: a quaternion and a translation."""
    return ColmapPose(tuple(numbers[:4]), tuple(numbers[4:]))


def _lines(path: Path) -> Iterator[str]:
    """The lines of a text model, stripped, without comments, empty lines and the observations of images."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(path, "", "text in UTF-8") from error
    is_image = False  # whether the line before is an image's; its second line may be empty, or left out
    for line in text.split("\n"):
        if line.startswith("#"):
            continue
        is_skipped = not line.strip() or (is_image and _is_observations(line))
        is_image = path.stem == "images" and not is_skipped
        if not is_skipped:
            yield line.strip()


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
    advice = "undistort the photos with colmap image_undistorter"
    raise DataError(path, f"camera {camera_id}", f"one of the models {known}", model, advice=advice)


def _add(path: Path, what: str, table: dict[int, T], key: int, value: T) -> None:
    if key in table:
        raise DataError(path, f"{what} {key}", "it once", "it twice")
    table[key] = value
