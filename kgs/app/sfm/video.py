"""Takes photos from a video: the sharpest frames, spread so that neighbours overlap.

How far the camera moved is told by points that are tracked from frame to frame: the angle under which a camera with a
usual lens would see their median way. Frames between which they hardly moved count as one place, however long the
camera rested there.

OpenCV turns frames as the header says, and converts their colours to RGB. Pixels that are not square become square
here.

Source: B. Lucas and T. Kanade, An iterative image registration technique, IJCAI 1981 (OpenCV's pyramidal version).
"""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Self

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from kgs._support.errors import DataError, PhotosRefused
from kgs._support.progress import ProgressBar
from kgs.app.files.encoders import NOT_UTF8, for_opencv
from kgs.app.files.outputs import write_png

from .find import MAX_FRAMES, MIN_PHOTOS
from .read import DEFAULT_FOCAL, sharpness

FRAMES = 12
MIN_DEGREES = 3.0  # between neighbours
MAX_DEGREES = 10.0
_LOOKED_AT = 500  # frames, spread over the video
_LONGEST = 480  # pixels of a frame that is looked at
_STEP = 0.75  # degrees; after so large a move new points are tracked
_TRACKED = 400  # points
_LOST = 30  # points, of which fewer tell no motion
_WIDEST_PIXEL = 4.0  # width over height of a pixel, or the inverse, above which a header is damaged

Grey = NDArray[np.uint8]
Points = NDArray[np.float32]  # `(N, 1, 2)`, pixels


class _Frame(NamedTuple):
    """A frame that was looked at."""

    number: int  # in the video
    sharpness: float
    way: float  # by how many degrees the camera had moved


def take_frames(
    video: Path, folder: Path, count: int | None, bar: ProgressBar, say: Callable[[str], None]
) -> list[Path]:
    """Write frames of a video to an empty folder, upright as its header says, as PNGs in the order of time.

    Unless a `count` is given: twelve, fewer where neighbours would be less than 3 degrees apart, and up to 36 where
    they would be more than 10 apart. A DataError about what is no video, PhotosRefused where the camera hardly moves.
    """
    frames = _look(video, bar)
    way = frames[-1].way
    min_way = _STEP * ((count or MIN_PHOTOS) - 1)
    if way < min_way or len(frames) < MIN_PHOTOS:
        expected = f"a video in which the camera moves by {min_way:g} degrees or more"
        raise PhotosRefused(video, "", expected, f"{way:.1f} degrees in {len(frames)} frames")
    if count is None:
        count = max(MIN_PHOTOS, min(FRAMES, round(way / MIN_DEGREES) + 1))
        count = max(count, min(MAX_FRAMES, math.ceil(way / MAX_DEGREES) + 1))
    indices = _sharpest(frames, count)
    paths = []
    with _Reader(video) as reader:
        for index in bar(indices, "frames", "frame"):
            pixels = reader.read(index)
            paths.append(folder / f"frame_{index:05d}.png")
            write_png(paths[-1], torch.from_numpy(pixels[..., ::-1].copy()).permute(2, 0, 1))
    say(f"{video.name}: {len(paths)} frames, {way / (len(paths) - 1):.0f} degrees apart in the mean")
    return paths


def _look(video: Path, bar: ProgressBar) -> list[_Frame]:
    """Frames spread over a video, at least one, with their sharpness and way."""
    frames = list[_Frame]()
    with _Reader(video) as reader:
        motion = _Motion()
        count = reader.count()
        for index in bar(range(0, count, max(1, count // _LOOKED_AT)), "video", "frame"):
            pixels = reader.read(index)
            scale = min(1.0, _LONGEST / max(pixels.shape))
            full = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
            resized = cv2.resize(full, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            grey = np.asarray(resized, np.uint8)
            frames.append(_Frame(index, sharpness(grey), motion.way_to(grey)))
    if not frames:
        raise DataError(video, "", "a video", "a file without frames that can be decoded")
    return frames


def _sharpest(frames: list[_Frame], count: int) -> list[int]:
    """The indices of so many frames, at most all: of each stretch of the way the sharpest in its middle half."""
    ways = np.array([frame.way for frame in frames])
    sharp = np.array([frame.sharpness for frame in frames])
    count = min(count, len(frames))
    reach = ways[-1] / (count - 1) / 4
    chosen = list[int]()
    for k, target in enumerate(np.linspace(0, ways[-1], count)):
        first = chosen[-1] + 1 if chosen else 0
        free = np.arange(first, len(frames) - (count - 1 - k))  # the others still find a place behind it
        distances = np.abs(ways[free] - target)
        near = free[distances <= max(reach, distances.min())]
        chosen.append(int(near[sharp[near].argmax()]))
    return [frames[index].number for index in chosen]


class _Motion:
    """Tells by how many degrees a camera has moved on its way."""

    def __init__(self) -> None:
        self._way = 0.0  # to where the points were chosen
        self._last: Grey | None = None
        self._start: Points = np.zeros((0, 1, 2), np.float32)  # where the points were then
        self._points: Points = self._start

    def way_to(self, grey: Grey) -> float:
        """The degrees up to the next frame."""
        if self._last is None:
            self._choose(grey)
            return 0.0
        if len(self._points):
            points, found, _ = cv2.calcOpticalFlowPyrLK(self._last, grey, self._points, self._points.copy())
            kept = found[:, 0] == 1
            self._start = self._start[kept]
            self._points = np.asarray(points[kept], np.float32)
        self._last = grey
        shifts = np.linalg.norm(self._points - self._start, axis=2)
        focal = DEFAULT_FOCAL * max(grey.shape)
        moved = math.degrees(math.atan(float(np.median(shifts)) / focal)) if len(shifts) >= _LOST else _STEP
        way = self._way + moved
        if moved >= _STEP:
            self._way = way
            self._choose(grey)
        return way

    def _choose(self, grey: Grey) -> None:
        corners = cv2.goodFeaturesToTrack(grey, _TRACKED, 0.01, 7)
        self._points = np.zeros((0, 1, 2), np.float32) if corners is None else np.asarray(corners, np.float32)
        self._start = self._points
        self._last = grey


class _Reader:
    """Reads frames of a video in the order of time, with square pixels."""

    def __init__(self, video: Path) -> None:
        path = for_opencv(video)
        if path is None:
            raise DataError(video, "", "a video that OpenCV can open", advice=f"{NOT_UTF8}")
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # else FFmpeg writes of damage to stderr
        self._path = str(path)
        self._capture = cv2.VideoCapture(self._path)
        self._next = 0
        self._pixel_width = self._aspect()  # over its height

    def _aspect(self) -> float:
        """Width over height of a pixel of an upright frame, or 1."""
        width, height = (self._capture.get(key) for key in (cv2.CAP_PROP_SAR_NUM, cv2.CAP_PROP_SAR_DEN))
        if not (width > 0 and height > 0 and 1 / _WIDEST_PIXEL <= width / height <= _WIDEST_PIXEL):
            return 1.0
        is_sideways = self._capture.get(cv2.CAP_PROP_ORIENTATION_META) % 180 == 90
        return height / width if is_sideways else width / height

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._capture.release()

    def count(self) -> int:
        """The number of frames that are decoded: headers guess it from a rate and a duration. Begins again."""
        count = sum(1 for _ in iter(self._capture.grab, False))
        self._capture.release()
        self._capture = cv2.VideoCapture(self._path)
        self._next = 0
        return count

    def read(self, index: int) -> NDArray[np.uint8]:
        """A frame, `(H, W, 3)` BGR, behind the last one that was read; never made smaller to have square pixels."""
        while self._next <= index:
            self._capture.grab()
            self._next += 1
        done, pixels = self._capture.retrieve()
        if not done:
            raise DataError(self._path, "", f"frame {index} again", "none")
        height, width = pixels.shape[:2]
        size = round(width * max(self._pixel_width, 1.0)), round(height / min(self._pixel_width, 1.0))
        if size == (width, height):
            return np.asarray(pixels, np.uint8)
        return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_CUBIC), np.uint8)
