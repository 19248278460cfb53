"""Films as files: MP4 (H.264) where PyAV is installed and has an encoder to use, else WebM (VP8) by OpenCV.

No package that pip installs on Linux has an H.264 encoder under a permissive licence (docs/tried.md), so kgs asks for
none. Where the user has installed PyAV, encoders of the BSD licence or of the system are used; any other one, such as
libx264 (GPL), where the environment variable KGS_H264 names it.
"""

import contextlib
import os
import time
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
ASKED = "KGS_H264"  # environment variable: the encoder of FFmpeg to use
_ENCODERS = ("libopenh264", "h264_videotoolbox", "h264_mf")  # BSD; of macOS; of Windows
_H264 = 27  # FFmpeg's number of the codec
_WAITING = 4  # most frames that wait for the encoder
# A WebM file is written as if it played this many times slower. OpenCV lets nobody choose a mode of libvpx, which takes
# its fast one, of a fifth of the time, where a frame lasts longer than the second that FFmpeg allows for it.
_SLOWER = 25
_TICK = 10**6  # nanoseconds in a WebM file as it is written
_HEAD_BYTES = 1024  # of a WebM file: the frames come after less
_OPTIONS = {"profile": "main", **dict.fromkeys(("colorspace", "color_primaries", "color_trc"), "bt709")}
Frame = NDArray[Any]  # of uint8


def film_suffix() -> tuple[str, str]:
    """The format of films here, `MP4` or `WEBM`, and a sentence if the user asked for an MP4 that cannot be written."""
    asked = os.environ.get(ASKED, "")
    try:
        import av
    except ImportError:
        return WEBM, f"no film as MP4: {ASKED}={asked} needs PyAV (pip install av)" if asked else ""
    if h264_encoder():
        return MP4, ""
    return WEBM, f"no film as MP4: PyAV {av.__version__} has no encoder {ASKED}={asked} that works" if asked else ""


def h264_encoder() -> str:
    """The name of the encoder of H.264 to use; "" where there is none."""
    try:
        import av
    except ImportError:
        return ""
    for name in (os.environ[ASKED],) if os.environ.get(ASKED) else _ENCODERS:
        with contextlib.suppress(av.FFmpegError, ValueError, OSError):
            context: Any = av.CodecContext.create(name, "w")
            if context.codec.id == _H264:
                context.width = 64
                context.height = 64
                context.pix_fmt = "yuv420p"
                context.time_base = Fraction(1, RATE)
                context.framerate = Fraction(RATE)
                context.open()
                return name
    return ""


def encode(path: Path, frames: Iterable[Frame], size: tuple[int, int]) -> str:
    """Write frames as a film, MP4 or WebM by the suffix. A frame is encoded while the next ones are made.

    MP4 is H.264 of the main profile or below, yuv420p in BT.709, with its index in front, so that it plays on phones
    and while it is loaded. (OpenCV's VP9 encoder takes six times as long as VP8 for 0.5 dB.)

    Args:
        path: the file to write.
        frames: `(height, width, 3)` each, BGR.
        size: width and height, even numbers.

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
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, RATE / _SLOWER, size)
    if not writer.isOpened():
        return 0, "this OpenCV writes no WebM files"
    try:
        count = _in_thread(writer.write, frames)
    finally:
        writer.release()
    return count, "" if _speed_up(path, count / RATE) else "this OpenCV writes WebM files of another layout"


def _speed_up(path: Path, seconds: float) -> bool:
    """Make a WebM file play `_SLOWER` times as fast, so that it lasts so many seconds; False if that cannot be done.

    All its times count ticks of a length that its head states. The head also has the time of a frame and, as FFmpeg
    writes it, that of the film, for programs that show them. Sources: RFC 8794 (EBML), RFC 9559 (Matroska).
    """
    length = time.strftime("%H:%M:%S", time.gmtime(seconds)) + f"{seconds % 1:.9f}"[1:]
    values = {
        b"\x2a\xd7\xb1\x83": (_TICK // _SLOWER).to_bytes(3, "big"),  # TimestampScale
        b"\x23\xe3\x83\x84": (10**9 // RATE).to_bytes(4, "big"),  # DefaultDuration
        b"DURATION\x44\x87\x93": length.encode(),
    }
    with path.open("r+b") as file:
        head = file.read(_HEAD_BYTES)
        offsets = {element: head.find(element) for element in values}
        for element, offset in offsets.items():
            if offset >= 0:
                file.seek(offset + len(element))
                file.write(values[element])
    return min(offsets.values()) >= 0


def _write_mp4(path: Path, frames: Iterable[Frame], size: tuple[int, int]) -> tuple[int, str]:
    """Write frames as H.264; returns their number, and why it failed or ""."""
    name = h264_encoder()
    if not name:
        return 0, "there is no encoder of H.264 here"
    import av

    try:
        with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as file:
            stream: Any = file.add_stream(name, rate=RATE, options=dict(_OPTIONS))
            stream.width, stream.height = size
            stream.pix_fmt = "yuv420p"
            stream.bit_rate = round(BITS * RATE * size[0] * size[1])

            def write(frame: Frame) -> None:
                picture = av.VideoFrame.from_ndarray(frame, format="bgr24")
                file.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")))

            count = _in_thread(write, frames)
            file.mux(stream.encode())
    except av.FFmpegError as error:
        return 0, f"{name}: {error}"
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
