"""Films as files: MP4 (H.264) by PyAV where it is installed, else WebM (VP8) by OpenCV.

PyAV's packages bring x264, which is GPL (docs/results/tried.md), so kgs does not ask for them.
"""

import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

RATE = 24  # frames per second
BITS = 0.2  # of H.264 for each pixel: six seconds of 640x426 have 1.0 MB
MP4 = ".mp4"
WEBM = ".webm"
NOT_UTF8 = "its path is not UTF-8"
_H264 = "h264"  # stands for the first encoder of it that FFmpeg has
_WAITING = 4  # most frames that wait for the encoder
_OPTIONS = {"profile": "main", **dict.fromkeys(("colorspace", "color_primaries", "color_trc"), "bt709")}
Frame = NDArray[Any]  # of uint8


def film_suffix() -> str:
    """The format of films here: `MP4` where PyAV is installed and has an encoder of H.264 that works, else `WEBM`."""
    try:
        import av
    except ImportError:
        return WEBM
    try:
        context: Any = av.CodecContext.create(_H264, "w")
        context.width = 64
        context.height = 64
        context.pix_fmt = "yuv420p"
        context.time_base = Fraction(1, RATE)
        context.framerate = Fraction(RATE)
        context.open()
    except (av.FFmpegError, ValueError, OSError):
        return WEBM
    return MP4


def encode(path: Path, frames: Iterable[Frame], size: tuple[int, int]) -> str:
    """Write frames as a film, MP4 or WebM by the suffix. A frame is encoded while the next ones are made.

    MP4 is H.264 of the main profile or below, yuv420p in BT.709, with its index in front, so that it plays on phones
    and while it is loaded. (OpenCV's VP9 encoder takes six times as long as VP8 for 0.5 dB.) Frames are BGR,
    `(height, width, 3)`; `size` is width and height, even numbers.

    Returns:
        "", or the reason why there is no such film; what is at `path` then is not one.
    """
    whole = for_opencv(path)
    if whole is None:
        return NOT_UTF8
    path = whole
    write = _write_mp4 if path.suffix == MP4 else _write_webm
    count, why = write(path, frames, size)
    if not why and round(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT)) != count:
        why = "it could not be written whole"
    return why


def for_opencv(path: Path) -> Path | None:
    """The path of a film as OpenCV takes it, or None if it is not UTF-8, which would end the process.

    It is absolute: FFmpeg takes what stands before a colon for a protocol.
    """
    whole = path.absolute()
    try:
        str(whole).encode()
    except UnicodeEncodeError:
        return None
    return whole


def _in_thread(work: Callable[[Any], Any], frames: Iterable[Any]) -> int:
    """Call `work` with each frame in a thread of its own, in order, while the next ones are made; returns their number.

    What `work` or the frames raise is raised here, once the frames before it are done.
    """
    count = 0
    waiting = deque[Future[Any]]()
    with ThreadPoolExecutor(1, "encoder") as encoder:
        for frame in frames:
            waiting.append(encoder.submit(work, frame))
            count += 1
            if len(waiting) > _WAITING:
                waiting.popleft().result()
        for done in waiting:
            done.result()
    return count


def _write_webm(path: Path, frames: Iterable[Frame], size: tuple[int, int]) -> tuple[int, str]:
    """Write frames as VP8; returns their number, and why it failed or ""."""
    with _stderr_discarded():
        code = cv2.VideoWriter.fourcc(*"VP80")
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, RATE, size)
    if not writer.isOpened():
        return 0, "this OpenCV writes no WebM files"
    try:
        return _in_thread(writer.write, frames), ""
    finally:
        writer.release()


def _write_mp4(path: Path, frames: Iterable[Frame], size: tuple[int, int]) -> tuple[int, str]:
    """Write frames as H.264; returns their number, and why it failed or ""."""
    if film_suffix() != MP4:
        return 0, "it needs PyAV (pip install av) and an encoder of H.264"
    import av

    try:
        with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as file:
            stream: Any = file.add_stream(_H264, rate=RATE, options=dict(_OPTIONS))
            stream.width, stream.height = size
            stream.pix_fmt = "yuv420p"
            stream.bit_rate = round(BITS * RATE * size[0] * size[1])

            def write(frame: Frame) -> None:
                picture = av.VideoFrame.from_ndarray(frame, format="bgr24")
                file.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")))

            count = _in_thread(write, frames)
            file.mux(stream.encode())
    except av.FFmpegError as error:
        return 0, str(error)
    return count, ""


@contextlib.contextmanager
def _stderr_discarded() -> Iterator[None]:
    """Discards what native code writes to stderr: OpenCV prints a remark for each WebM file."""
    stderr = os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(null)
