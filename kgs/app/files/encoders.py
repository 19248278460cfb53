"""Films as files: MP4 (H.264) where PyAV is installed and has an encoder to use, else WebM (VP8) by OpenCV.

No package that pip installs on Linux has an H.264 encoder under a permissive licence (docs/tried.md), so kgs asks for
none. Where the user has installed PyAV, encoders of the BSD licence or of the system are used; any other one, such as
libx264 (GPL), where the environment variable KGS_H264 names it.
"""

import contextlib
import os
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

RATE = 24  # frames per second
BITS = 0.2  # of H.264 for each pixel: six seconds of 640x426 have 1.0 MB, and go into the page as they are
MP4 = ".mp4"
WEBM = ".webm"
ASKED = "KGS_H264"  # environment variable: the encoder of FFmpeg to use
_ENCODERS = ("libopenh264", "h264_videotoolbox", "h264_mf")  # BSD; of macOS; of Windows
_H264 = 27  # FFmpeg's number of the codec
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


def encode(path: Path, frames: Iterable[Frame], size: tuple[int, int], rate: float = 0.0) -> str:
    """Write frames as a film, MP4 or WebM by the suffix.

    MP4 is H.264 of the main profile or below, yuv420p in BT.709, with its index in front, so that it plays on phones
    and while it is loaded. (OpenCV's VP9 encoder takes six times as long as VP8 for 0.5 dB.)

    Args:
        path: the file to write.
        frames: `(height, width, 3)` each, BGR.
        size: width and height, even numbers.
        rate: bits per second of H.264; 0: `BITS` for each pixel. VP8 takes about a bit for each pixel.

    Returns:
        "", or the reason why there is no such film; what is at `path` then is not one.
    """
    write = _write_mp4 if path.suffix == MP4 else _write_webm
    count, why = write(path, frames, size, rate)
    if not why and round(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT)) != count:
        why = "it could not be written whole"
    return why


def _write_webm(path: Path, frames: Iterable[Frame], size: tuple[int, int], _: float) -> tuple[int, str]:
    """Write frames as VP8; returns their number, and why it failed or ""."""
    count = 0
    with _stderr_discarded():
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"VP80"), RATE, size)
    if not writer.isOpened():
        return 0, "this OpenCV writes no WebM files"
    for frame in frames:
        writer.write(frame)
        count += 1
    writer.release()
    return count, ""


def _write_mp4(path: Path, frames: Iterable[Frame], size: tuple[int, int], rate: float) -> tuple[int, str]:
    """Write frames as H.264; returns their number, and why it failed or ""."""
    count = 0
    name = h264_encoder()
    if not name:
        return 0, "there is no encoder of H.264 here"
    import av

    try:
        with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as file:
            stream: Any = file.add_stream(name, rate=RATE, options=dict(_OPTIONS))
            stream.width, stream.height = size
            stream.pix_fmt = "yuv420p"
            stream.bit_rate = round(rate or BITS * RATE * size[0] * size[1])
            for frame in frames:
                picture = av.VideoFrame.from_ndarray(frame, format="bgr24")
                file.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")))
                count += 1
            file.mux(stream.encode())
    except av.FFmpegError as error:
        return count, f"{name}: {error}"
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
