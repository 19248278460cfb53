"""The film: its path through the cameras, its frames, and that a browser plays it."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from browser import Browser
from factories import looking_at, pinhole, with_camera
from torch import Tensor

from kgs.app.files import encoders, film
from kgs.app.files.film import camera_path, write_film
from kgs.datasets.scene import Views
from kgs.geometry.rigs import camera_centers, degrees_between


def ring(count: int, radius: float = 3.0) -> Tensor:
    """Cameras around the z axis in a scrambled order, at several heights."""
    angles = 2 * math.pi * torch.arange(count).double() / count
    ringed = torch.stack([radius * angles.cos(), radius * angles.sin(), 1 + 0.3 * (3 * angles).sin()], 1)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(count))
    return looking_at(torch.zeros(3), ringed[order], torch.tensor([0.0, 0.0, 1.0]))


def facing(count: int) -> Tensor:
    """Cameras side by side that look ahead."""
    poses = torch.eye(4).double().repeat(count, 1, 1)
    poses[:, :3, 3] = -torch.rand(count, 3, generator=torch.Generator().manual_seed(count)).double() * torch.tensor(
        [2.0, 1.0, 0.1]
    )
    return poses


def evenly(frames: int) -> Any:
    return np.arange(frames) / frames


PATHS = {
    "ring of 3": ring(3),
    "ring of 8": ring(8),
    "2 facing": facing(2),
    "3 facing": facing(3),
    "6 facing": facing(6),
}


@pytest.mark.parametrize("poses", PATHS.values(), ids=PATHS)
def test_the_path_passes_each_camera_and_is_smooth(request: Any, poses: Tensor) -> None:
    path = camera_path(poses, evenly(2000), 1.0)
    if "6 facing" in request.node.name:  # cameras side by side are never left
        assert (camera_centers(path) >= camera_centers(poses).amin(0) - 1e-9).all()
        assert (camera_centers(path) <= camera_centers(poses).amax(0) + 1e-9).all()
    for pose in poses:
        nearest = int((path - pose).abs().amax((1, 2)).argmin())
        assert (camera_centers(path)[nearest] - camera_centers(pose[None])[0]).norm() < 0.02
        assert degrees_between(path[nearest, :3, :3], pose[:3, :3]) < 0.5
    assert torch.allclose(path[:, :3, :3] @ path[:, :3, :3].mT, torch.eye(3).double(), atol=1e-12)
    moves = camera_centers(path).diff(dim=0, append=camera_centers(path)[:1])  # the first frame follows the last
    turns = degrees_between(path[:, :3, :3], path.roll(-1, 0)[:, :3, :3])
    assert moves.norm(dim=1).max() < 4 * moves.norm(dim=1).mean()
    assert turns.max() <= 4 * turns.mean() + 1e-3
    assert (moves.diff(dim=0).norm(dim=1) < 0.2 * moves.norm(dim=1).max()).all()  # no corner


def test_cameras_around_an_object_are_passed_on_arcs_that_look_at_it() -> None:
    poses = ring(5)
    path = camera_path(poses, evenly(100), 1.0)
    positions = camera_centers(path)
    radii, lengths = positions.norm(dim=1), camera_centers(poses).norm(dim=1)
    assert (lengths.min() - 0.05 < radii).all()  # a chord of the ring would come to 2.4
    assert (radii < lengths.max() + 0.05).all()
    assert (-(path[:, 2, :3] * positions).sum(1) / radii > 0.999).all()
    turned = torch.atan2(positions[:, 1], positions[:, 0]).diff().remainder(2 * math.pi)
    assert min(turned.sum(), (2 * math.pi - turned).sum()) < 2 * math.pi  # once around


@pytest.mark.parametrize("poses", [*PATHS.values(), ring(12), ring(7)[:1]], ids=[*PATHS, "ring of 12", "1"])
def test_the_camera_moves_at_one_speed_between_the_ends(poses: Tensor) -> None:
    """Measured on the poses of the film: where the path does not turn back, steps are as long as each other."""
    path = film.resample_by_speed(poses, 400, 3.0)
    positions = camera_centers(path)
    unit = torch.cdist(camera_centers(poses), camera_centers(poses)).max() if len(poses) > 1 else 3.0
    moves = torch.cat([positions / unit, path[:, 2, :3] / math.pi], 1).diff(dim=0)
    lengths = moves.norm(dim=1)
    ahead = moves / lengths[:, None]
    turns = (ahead[1:] * ahead[:-1]).sum(1).clamp(-1, 1).acos().rad2deg()
    cruise = lengths.quantile(0.75)
    assert (lengths <= 1.03 * cruise).all()  # at its speed, and never above
    bends = torch.nn.functional.max_pool1d(turns[None], 25, 1, 12)[0]  # sharpest turn within 12 frames
    calm = (bends < 4)[50:348]
    assert calm.float().mean() > 0.5
    torch.testing.assert_close(lengths[51:349][calm], cruise.expand(int(calm.sum())), rtol=0.03, atol=0)
    assert lengths[[0, -1]].max() < 0.1 * cruise
    assert (lengths[:20].diff() > -1e-6 * cruise).all()  # gets up to its speed
    assert (lengths[-20:].diff() < 1e-6 * cruise).all()
    assert (lengths.diff().abs() < 0.25 * cruise).all()  # no jolt
    torch.testing.assert_close(path[0], camera_path(poses, evenly(1), 3.0)[0])


@pytest.mark.parametrize(("count", "bound"), [(12, 1.2), (40, 1.3)])
def test_the_round_trip_is_short(count: int, bound: float) -> None:
    path = camera_path(ring(count), evenly(120), 1.0)
    assert camera_centers(path).diff(dim=0).norm(dim=1).sum() < 2 * math.pi * 3.0 * bound


def test_a_single_camera_sways_and_keeps_its_target() -> None:
    pose = ring(7)[2]
    path = camera_path(pose[None], evenly(60), depth=4.0)
    torch.testing.assert_close(path[0], pose)
    target = torch.linalg.inv(pose) @ torch.tensor([0.0, 0.0, 4.0, 1.0]).double()
    seen = path @ target
    torch.testing.assert_close(seen[:, :2], torch.zeros(60, 2).double(), atol=1e-9, rtol=0)
    moved = (camera_centers(path) - camera_centers(pose[None])).norm(dim=1)
    assert 0.05 < moved.max() < 0.5


def test_cameras_with_one_centre_are_no_trouble() -> None:
    assert camera_path(facing(1).repeat(3, 1, 1), evenly(10), 1.0).isfinite().all()
    assert film.resample_by_speed(facing(1).repeat(3, 1, 1), 10, 1.0).isfinite().all()


def views_of(size: tuple[int, int]) -> Views:
    cameras = pinhole(*size, 0.9 * size[1], dtype=torch.float32, cameras=3)
    return Views(with_camera(cameras, facing(3).float()), torch.zeros(3, 3, *size), ("a", "b", "c"))


def render(camera: Any) -> Tensor:
    """A picture that says from where it was taken: a bright bar where a point 2 before the origin is."""
    height, width = int(camera.height), int(camera.width)
    column = float(camera.project(torch.tensor([[[1.0, 0.5, 2.0]]]))[0, 0, 0])
    bar = torch.exp(-(((torch.arange(width) - column) / (0.05 * width)) ** 2))
    return torch.stack([bar, 0.8 * bar, 0.6 * bar])[None, :, None].expand(1, 3, height, width)


@pytest.fixture(params=["webm", "mp4"])
def suffix(request: Any) -> str:
    """Of a film that can be made here: MP4 by the encoder that PyAV's packages have on Linux."""
    if request.param == "mp4":
        pytest.importorskip("av")
        assert encoders.film_suffix() == ".mp4"
    return f".{request.param}"


@pytest.mark.parametrize(("count", "size", "expected"), [(8, (33, 45), (32, 44)), (3, (1400, 2100), (1280, 1920))])
def test_the_frames_are_the_renders(
    tmp_path: Path, monkeypatch: Any, suffix: str, count: int, size: Any, expected: Any
) -> None:
    monkeypatch.setattr(film, "FRAMES", count)
    monkeypatch.setattr(encoders, "BITS", 2.0)
    rendered = []

    def kept(camera: Any) -> Tensor:
        rendered.append(render(camera)[0])
        return rendered[-1][None]

    views, path = views_of(size), tmp_path / f"film{suffix}"
    assert write_film(path, kept, views, 1.0) == ""
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    video, frames = cv2.VideoCapture(str(path)), []
    while (found := video.read())[0]:
        frames.append(torch.from_numpy(np.ascontiguousarray(found[1][:, :, ::-1])).permute(2, 0, 1) / 255)
    assert len(frames) == count
    assert tuple(frames[0].shape[1:]) == expected
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(24)
    for frame, image in zip(frames, rendered, strict=True):
        assert (frame - image).square().mean() < 2e-3  # 27 dB; another frame's bar is at other pixels
    small, photo = rendered[0][0, 0], render(views.camera(0))[0, 0, 0]  # of the first camera, in two sizes
    centre = [float((row * (torch.arange(len(row)) + 0.5)).sum() / row.sum()) / len(row) for row in (small, photo)]
    assert centre[0] == pytest.approx(centre[1], abs=1e-3)


def test_a_phone_plays_the_mp4(tmp_path: Path) -> None:
    """Main profile, 4:2:0, eight bits, the index in front; as the bytes of ISO/IEC 14496-12, not by FFmpeg."""
    pytest.importorskip("av")
    frame = np.zeros((48, 96, 3), np.uint8)
    assert encoders.encode(tmp_path / "a.mp4", [frame] * 30, (96, 48)) == ""
    content = (tmp_path / "a.mp4").read_bytes()
    assert content[4:8] == b"ftyp"
    assert content.index(b"moov") < content.index(b"mdat")
    configuration = content[content.index(b"avcC") + 4 :]
    assert configuration[1] in (66, 77)  # baseline, main (ISO/IEC 14496-15)
    assert configuration[3] <= 31  # level 3.1: 1280x720 at 30 frames per second
    assert b"avc1" in content


def test_the_colours_of_a_film_are_those_of_the_frames(tmp_path: Path, suffix: str) -> None:
    colors = [(200, 40, 40), (40, 200, 40), (40, 40, 200), (230, 230, 230), (20, 20, 20)]
    frame = np.repeat(np.array(colors, np.uint8)[None], 64, 0).repeat(32, 1)
    path = tmp_path / f"a{suffix}"
    assert encoders.encode(path, [frame] * 5, (160, 64)) == ""
    shown = cv2.VideoCapture(str(path)).read()[1][32, 16::32]
    np.testing.assert_allclose(shown.astype(int), colors, rtol=0, atol=6)


def test_each_frame_has_its_time(tmp_path: Path, suffix: str) -> None:
    """Read by PyAV, which takes all times of a file into account. WebM counts milliseconds."""
    av = pytest.importorskip("av")
    path = tmp_path / f"a{suffix}"
    assert encoders.encode(path, [np.zeros((48, 64, 3), np.uint8)] * 60, (64, 48)) == ""
    with av.open(str(path)) as file:
        times = [frame.time for frame in file.decode(video=0)]
        stream = file.streams.video[0]
        assert stream.average_rate == 24
        assert file.duration / 1e6 == pytest.approx(2.5, abs=0.002)
        assert stream.metadata.get("DURATION", "00:00:02.500000000") == "00:00:02.500000000"
    assert times == pytest.approx([i / 24 for i in range(60)], abs=1e-4 if suffix == ".mp4" else 5e-4)


@pytest.mark.parametrize("last", [0, 2, 9])
def test_an_error_of_the_encoder_reaches_the_caller(last: int) -> None:
    """Also of the last frame, after which no other one is made; and no frame comes after it."""
    encoded: list[int] = []

    def work(frame: Any) -> None:
        encoded.append(frame)
        if frame == last:
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        encoders._in_thread(work, iter(range(10)))
    assert encoded[: last + 1] == list(range(last + 1))


def no_session(*_: Any, **__: Any) -> None:
    raise pytest.importorskip("av").error.ExternalError(1, "no session left")


@pytest.mark.parametrize(
    ("name", "replaced", "by", "reason"),
    [
        ("a.mp4", None, None, "no a.mp4: it needs PyAV"),
        ("a.mp4", "kgs.app.files.encoders._H264", "h264_nothing", "no a.mp4: it needs PyAV"),
        ("a.mp4", "kgs.app.files.encoders._H264", "h264_v4l2m2m", "no a.mp4: it needs PyAV"),  # a device is not there
        ("a.mp4", "av.open", no_session, "no a.mp4: .*no session left"),
        ("a.webm", "cv2.VideoWriter.fourcc", lambda *_: 0, "no a.webm: this OpenCV writes no WebM"),
    ],
    ids=["package", "encoder", "device", "session", "codec"],
)
def test_what_fails_leaves_a_reason_and_no_file(
    tmp_path: Path, monkeypatch: Any, name: str, replaced: str | None, by: Any, reason: str
) -> None:
    if replaced is None:
        monkeypatch.setitem(sys.modules, "av", None)
    else:
        pytest.importorskip("av")
        monkeypatch.setattr(replaced, by)
    assert (encoders.film_suffix() == ".webm") == ("needs" in reason)
    assert re.match(reason, write_film(tmp_path / name, render, views_of((12, 16)), 1.0))
    assert list(tmp_path.iterdir()) == []


def test_a_relative_path_may_have_a_colon_and_one_that_is_no_utf8_is_refused(
    tmp_path: Path, monkeypatch: Any, suffix: str
) -> None:
    monkeypatch.setattr(film, "FRAMES", 8)
    monkeypatch.chdir(tmp_path)
    folder = Path("2024:05")
    folder.mkdir()
    assert write_film(folder / f"film{suffix}", render, views_of((33, 45)), 1.0) == ""
    assert [path.name for path in folder.iterdir()] == [f"film{suffix}"]
    wrong = Path("a\udcff")
    wrong.mkdir()
    assert "its path is not UTF-8" in write_film(wrong / f"film{suffix}", render, views_of((33, 45)), 1.0)
    assert list(wrong.iterdir()) == []


def test_a_render_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "film.webm").write_bytes(b"before")

    def failing(_: Any) -> Tensor:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(tmp_path / "film.webm", failing, views_of((12, 16)), 1.0)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("film.webm", b"before")]


@pytest.mark.slow
def test_a_browser_plays_it(tmp_path: Path, monkeypatch: Any, suffix: str) -> None:
    monkeypatch.setattr(film, "FRAMES", 15)
    path = tmp_path / f"film{suffix}"
    (tmp_path / "page.html").write_text(f'<video id="v" src="{path.name}" preload="auto" muted></video>')
    flat = torch.tensor([200, 40, 90]).reshape(1, 3, 1, 1) / 255
    with Browser(tmp_path / "profile") as page:
        assert write_film(path, lambda _: flat.expand(1, 3, 48, 64), views_of((48, 64)), 1.0) == ""
        page.open(tmp_path / "page.html", ready="v.error || v.readyState == 4")
        assert page.run("v.error && v.error.message") is None
        assert page.run("[v.videoWidth, v.videoHeight]") == [64, 48]
        assert page.run("v.duration") == pytest.approx(15 / 24, abs=0.05)
        page.run("v.play()")
        page.run("new Promise(done => { v.onended = done })")
        page.call("Page.bringToFront")
        picture = page.picture("data:," + page.call("Page.captureScreenshot")["data"])
        bound = 3 if suffix == ".mp4" else 12  # OpenCV's VP8 is BT.601 and does not say so; Chromium takes it for 709
        np.testing.assert_allclose(picture[20:40, 20:60].mean((0, 1)) * 255, [200, 40, 90], rtol=0, atol=bound)
        assert page.problems == []
