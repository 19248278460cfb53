"""Photos from a video: sharp frames, spread by how far the camera moved, upright as the file's header says."""

import shutil
import struct
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import run
from init_point_scenes import texture

from kgs._support.errors import DataError
from kgs._support.progress import silent
from kgs.app.sfm.find import find_video
from kgs.app.sfm.video import FRAMES, _Reader, take_frames

SIZE = (320, 240)
SMALL = (160, 120)


def write_video(path: Path, degrees: list[float], blurred: tuple[int, ...] = (), size=SIZE) -> Path:
    """Frames of a wall along which a camera moves: its points have moved by so many degrees."""
    wall = texture(0, (220.0, 220.0, 220.0)).astype(np.uint8)
    code = "MJPG" if path.suffix == ".avi" else "mp4v"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 30, size)
    assert writer.isOpened()
    focal = 0.8 * size[0]
    for i, angle in enumerate(degrees):
        move = np.array([[1, 0, -focal * np.tan(np.radians(angle))], [0, 1, -20.0]])
        frame = cv2.warpAffine(wall, move, size, borderMode=cv2.BORDER_WRAP)
        writer.write(cv2.GaussianBlur(frame, (0, 0), 3.0) if i in blurred else frame)
    writer.release()
    return path


def take(video: Path, count: int | None = None) -> list[int]:
    folder = video.with_suffix("")
    folder.mkdir()
    lines: list[str] = []
    paths = take_frames(video, folder, count, silent, lines.append)
    assert paths == sorted(folder.iterdir())
    assert f"{len(paths)} frames" in lines[-1]
    return [int(path.stem.removeprefix("frame_")) for path in paths]


def test_frames_are_spread_by_motion_and_sharp(tmp_path):
    rest = [0.0] * 40
    way = np.linspace(0, 40, 81).tolist()
    blurred = tuple(range(41, 121, 2))
    numbers = take(write_video(tmp_path / "clip.avi", rest + way, blurred, SMALL))
    assert len(numbers) == FRAMES
    assert not set(numbers) & set(blurred)
    angles = np.array([([*rest, *way])[i] for i in numbers])
    assert np.diff(angles).min() > 1.0  # the camera rests in one frame at most
    assert np.diff(angles).max() < 7.0


@pytest.mark.parametrize(("degrees", "count", "expected"), [(9, None, 4), (155, None, 17), (40, 5, 5), (40, 20, 20)])
def test_how_many_frames(tmp_path, degrees, count, expected):
    """Neighbours are 3 to 10 degrees apart, unless a number is given."""
    equal = np.degrees(np.arctan(np.radians(np.arange(0, degrees + 0.1)))).tolist()  # ways in the image
    assert len(take(write_video(tmp_path / "clip.avi", equal, size=SMALL), count)) == expected


def turn_by_a_quarter(video: Path) -> None:
    """Change the matrix in the header of an MP4."""
    data = video.read_bytes()
    at = data.index(b"tkhd") + 4 + 40  # version, flags, times, ids, duration, layer and volume, then the matrix
    one = 1 << 16
    turned = struct.pack(">9i", 0, one, 0, -one, 0, 0, SIZE[1] * one, 0, 1 << 30)
    video.write_bytes(data[:at] + turned + data[at + 36 :])


def test_a_frame_is_upright_as_the_header_says(tmp_path):
    video = write_video(tmp_path / "clip.mp4", np.linspace(0, 20, 30).tolist())
    turn_by_a_quarter(video)
    take(video, 3)
    first = cv2.imread(str(next(video.with_suffix("").iterdir())))
    assert first.shape[:2] == (SIZE[0], SIZE[1])  # 240 wide, 320 high


@pytest.mark.parametrize(("aspect", "size"), [("1", (320, 240)), ("4/3", (427, 240)), ("8/9", (320, 270))])
@pytest.mark.parametrize("name", ["clip.mkv", "clip.mp4", "turned.mp4"])
def test_pixels_become_square(tmp_path, aspect, size, name):
    """A circle is one, as the header says the shape of pixels: HDV has 4:3, DVDs 8:9 for instance."""
    av = pytest.importorskip("av")
    shape = Fraction(aspect)
    picture = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    cv2.ellipse(picture, (160, 120), (round(80 / shape), 80), 0, 0, 360, (255, 255, 255), -1)
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream("mpeg4", rate=10, options={"qscale": "1"})
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        stream.codec_context.sample_aspect_ratio = shape
        for packet in [*stream.encode(av.VideoFrame.from_ndarray(picture, "bgr24")), *stream.encode()]:
            container.mux(packet)
    if name == "turned.mp4":
        turn_by_a_quarter(tmp_path / name)
    with _Reader(tmp_path / name) as reader:
        frame = reader.read(0)
    assert frame.shape[1::-1] == (size[::-1] if name == "turned.mp4" else size)
    rows, columns = np.nonzero(frame[..., 1] > 128)
    assert np.ptp(rows) == pytest.approx(np.ptp(columns), abs=3)


def broken(path: Path) -> Path:
    video = write_video(path, [0.0, 5.0, 10.0])
    video.write_bytes(video.read_bytes()[:200])
    return video


def empty(path: Path) -> Path:
    path.write_bytes(b"\0\0\0\x18ftypisom" + bytes(100))
    return path


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (broken, "expected a video"),
        (empty, "expected a video"),
        (lambda path: write_video(path, [0.0]), "camera moves"),
        (lambda path: write_video(path, [0.0] * 30), "camera moves"),
    ],
    ids=["broken", "empty", "one frame", "at rest"],
)
def test_a_video_that_gives_no_photos(tmp_path, make, said, capsys):
    pytest.importorskip("pycolmap")
    video = make(tmp_path / "clip.mp4")
    with pytest.raises(DataError, match=said):
        take(video)
    assert run("fit", video, "-o", tmp_path / "out") == (4 if said == "camera moves" else 3)
    assert "clip.mp4" in capsys.readouterr().err
    assert not (tmp_path / "out" / "images").exists()


def test_a_relative_path_may_have_a_colon_and_one_that_is_no_utf8_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write_video(tmp_path / "clip.avi", np.linspace(0, 20, 21).tolist()).rename("22:33.avi")
    assert len(take(path, 4)) == 4
    with pytest.raises(DataError, match="its path is not UTF-8"):
        take(path.rename("a\udcff.avi"))


def test_ffmpeg_says_nothing_of_a_broken_video(tmp_path):
    """In a process of its own, since FFmpeg's first use in one decides how much it says."""
    code = "import sys; from pathlib import Path; from kgs.app.sfm.video import _Reader; _Reader(Path(sys.argv[1]))"
    done = subprocess.run([sys.executable, "-c", code, broken(tmp_path / "clip.mp4")], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_which_video_is_meant(tmp_path):
    video = write_video(tmp_path / "clip.avi", [0.0])
    assert find_video(video) == video
    assert find_video(tmp_path) == video
    (tmp_path / "other.MOV").write_bytes(b"")
    assert find_video(tmp_path) is None  # one of two
    (tmp_path / "other.MOV").unlink()
    (tmp_path / "IMG_1.HEIC").write_bytes(b"")
    assert find_video(tmp_path) is None  # a Live Photo stays a photo
    assert find_video(tmp_path / "nothing.mp4") is None


def thousand_a_second(video: Path) -> Path:
    """As screen recorders and browsers write Matroska and WebM: the rate is that of the clock."""
    av = pytest.importorskip("av")
    lying = video.with_suffix(".mkv")
    capture = cv2.VideoCapture(str(video))
    with av.open(str(lying), "w") as container:
        stream = container.add_stream("ffv1", rate=1000)
        stream.width, stream.height = SMALL
        stream.pix_fmt = "bgr0"
        for i, (_, pixels) in enumerate(iter(capture.read, (False, None))):
            frame = av.VideoFrame.from_ndarray(pixels, "bgr24")
            frame.pts, frame.time_base = 33 * i, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return lying


def of_length(video: Path, count: int) -> Path:
    """The header of an AVI says so many frames: 0 where the recorder did not know, or was stopped."""
    data = bytearray(video.read_bytes())
    for chunk, at in ((b"avih", 24), (b"strh", 40)):
        struct.pack_into("<I", data, data.index(chunk) + at, count)
    video.write_bytes(data)
    return video


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """A video of 50 frames, and which of them are taken."""
    video = write_video(tmp_path_factory.mktemp("honest") / "clip.avi", np.linspace(0, 40, 50).tolist(), size=SMALL)
    return video, take(video)


@pytest.mark.parametrize(
    ("lie", "count"),
    [
        (thousand_a_second, 49 * 33 + 1),
        (lambda video: of_length(video, 0), 0),
        (lambda video: of_length(video, 16), 16),
        (lambda video: of_length(video, 10**6), 10**6),
    ],
    ids=["1000 a second", "none", "few", "many"],
)
def test_frames_are_counted_as_they_are_decoded(honest, tmp_path, lie, count):
    video, expected = honest
    lying = lie(shutil.copy(video, tmp_path / video.name))
    assert cv2.VideoCapture(str(lying)).get(cv2.CAP_PROP_FRAME_COUNT) == count
    assert take(lying) == expected


def test_as_many_frames_as_are_asked_for_where_they_are_unevenly_spread(tmp_path):
    assert take(write_video(tmp_path / "clip.avi", [0.0, 5.0, 5.2]), 3) == [0, 1, 2]
