"""The readers of COLMAP's files, on bytes packed by hand from the format's description, whole and damaged."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from new_files import write_anew

from kgs._support.errors import DataError
from kgs.datasets.layouts.colmap_model import read_cameras, read_frames, read_images, read_points, read_rigs

CAMERA = struct.pack("<QIiQQ4d", 1, 3, 1, 8, 6, 5.0, 6.0, 4.0, 3.0)
IMAGES = (
    struct.pack("<QI7dI", 1, 9, 1, 0, 0, 0, 0.5, 0.25, 2, 3)
    + "bücher/ä.png".encode()
    + b"\0"
    + struct.pack("<Qddq", 1, 1.0, 2.0, -1)
)
RIGS = struct.pack("<QIIiIiIB7diIB", 1, 5, 3, 0, 3, 0, 4, 1, 1, 0, 0, 0, 0.5, 0.25, 2, 1, 7, 0)
FRAMES = struct.pack("<QII7dIiIQiIQ", 1, 6, 5, 1, 0, 0, 0, 0.5, 0.25, 2, 2, 0, 3, 9, 1, 7, 8)
POINTS = struct.pack("<QQ3d3BdQ4I", 1, 77, 1.0, 2.0, 3.0, 10, 20, 30, 0.5, 2, 9, 0, 4, 1)


def packed(folder: Path, name: str, data: bytes) -> Path:
    write_anew(folder / name, data)
    return folder / name


def test_hand_packed_bytes(tmp_path: Path) -> None:
    camera = read_cameras(packed(tmp_path, "cameras.bin", CAMERA))[3]
    assert (camera.model, camera.width, camera.height, camera.params) == ("PINHOLE", 8, 6, (5.0, 6.0, 4.0, 3.0))
    image = read_images(packed(tmp_path, "images.bin", IMAGES))[9]
    assert (image.name, image.camera_id) == ("bücher/ä.png", 3)
    assert image.pose == ((1, 0, 0, 0), (0.5, 0.25, 2))
    rig = read_rigs(packed(tmp_path, "rigs.bin", RIGS))
    assert rig == {5: {3: ((1, 0, 0, 0), (0, 0, 0)), 4: ((1, 0, 0, 0), (0.5, 0.25, 2))}}  # and a sensor of motion
    frames = read_frames(packed(tmp_path, "frames.bin", FRAMES))
    assert frames == {6: (5, ((1, 0, 0, 0), (0.5, 0.25, 2)), {9: 3})}
    path = packed(tmp_path, "points3D.bin", POINTS)
    points, colors = read_points(path, {4, 9})
    assert (points.tolist(), colors.tolist()) == ([[1.0, 2.0, 3.0]], [[10, 20, 30]])
    assert read_points(path, {4, 5})[0].shape == (0, 3)


READERS: dict[str, Callable[[Path], object]] = {
    "cameras.bin": read_cameras,
    "images.bin": read_images,
    "rigs.bin": read_rigs,
    "frames.bin": read_frames,
    "points3D.bin": lambda path: read_points(path, {4, 9}),
}


@pytest.mark.parametrize(
    ("name", "data"), list(zip(READERS, (CAMERA, IMAGES, RIGS, FRAMES, POINTS), strict=True)), ids=list(READERS)
)
def test_every_truncation_and_any_extra_byte_is_noticed(tmp_path: Path, name: str, data: bytes) -> None:
    for broken in [data[:size] for size in range(len(data))] + [data + b"\0"]:
        with pytest.raises(DataError, match=name):
            READERS[name](packed(tmp_path, name, broken))


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("count", [2**40, 2**64 - 1])
def test_a_lying_count_is_held_against_the_file(tmp_path: Path, name: str, count: int) -> None:
    path = packed(tmp_path, name, struct.pack("<Q", count) + b"\0" * 100)
    with pytest.raises(DataError, match=r"expected \d+ bytes at byte"):
        READERS[name](path)


def test_lying_lengths_within(tmp_path: Path) -> None:
    track = POINTS[:-24] + struct.pack("<Q4I", 2**61, 9, 0, 4, 1)
    with pytest.raises(DataError, match="track"):
        read_points(packed(tmp_path, "points3D.bin", track), {4, 9})
    for name, data in (("rigs.bin", RIGS), ("frames.bin", FRAMES)):
        at = 12 if name == "rigs.bin" else 72
        with pytest.raises(DataError, match=r"expected \d+ bytes at byte"):
            READERS[name](packed(tmp_path, name, data[:at] + struct.pack("<I", 2**32 - 1) + data[at + 4 :]))
    endless = IMAGES[:72] + b"x" * 10_000
    with pytest.raises(DataError, match="zero byte"):
        read_images(packed(tmp_path, "images.bin", endless))
    latin = IMAGES.replace("ä".encode(), b"\xe4\xe4")
    with pytest.raises(DataError, match="UTF-8"):
        read_images(packed(tmp_path, "images.bin", latin))


HEADS = [f"{i} 1 0 0 0 {i}.5 0.25 2 3 {name}" for i, name in enumerate(["a.png", "b c.png", "7", "d e f.png"], 1)]


@pytest.mark.parametrize("end", ["\n", ""])
@pytest.mark.parametrize("between", ["", "\n", "\n\n", "3.5 4.5 7\n", "3.5 4.5 7 1e2 0.5 -1\n", "# a remark\n", "\r\n"])
def test_texts_with_and_without_second_lines(tmp_path: Path, between: str, end: str) -> None:
    """COLMAP writes a second line for each photo, which may be empty; other tools leave it out."""
    text = "# Image list\n" + f"\n{between}".join(HEADS) + end
    images = read_images(packed(tmp_path, "images.txt", text.encode()))
    assert [image.name for image in images.values()] == ["a.png", "b c.png", "7", "d e f.png"]
    assert [image.pose.translation for image in images.values()] == [(i + 0.5, 0.25, 2) for i in range(1, 5)]


def test_texts_where_only_some_photos_have_second_lines(tmp_path: Path) -> None:
    text = f"\ufeff{HEADS[0]}\n1 2 3\n{HEADS[1]}\n{HEADS[2]}\n\n{HEADS[3]}\n4 5 -1 6 7 8\n"
    assert list(read_images(packed(tmp_path, "images.txt", text.encode()))) == [1, 2, 3, 4]


@pytest.mark.parametrize("line", ["1 2", "1 2 x", "1 2 3 4", f"{HEADS[0]} 1 2\n1 2 3\n1 2 3"])
def test_second_lines_that_are_none_are_refused(tmp_path: Path, line: str) -> None:
    with pytest.raises(DataError, match=r"images\.txt"):
        read_images(packed(tmp_path, "images.txt", f"{HEADS[1]}\n{line}\n{HEADS[2]}\n".encode()))


@pytest.mark.parametrize("text", [False, True])
def test_each_camera_model_of_pycolmap_is_read_or_refused_by_its_name(tmp_path: Path, text: bool) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    refused = {"FOV", "SIMPLE_DIVISION", "DIVISION", "EUCM", "EQUIRECTANGULAR"}
    refused |= {"THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"}
    models = {name: number for name, number in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    assert refused < models.keys()
    path = tmp_path / ("cameras.txt" if text else "cameras.bin")
    for name, number in models.items():
        camera = pycolmap.Camera.create_from_model_id(7, number, 40.0, 48, 32)
        scene = pycolmap.Reconstruction()
        scene.add_camera_with_trivial_rig(camera)
        (scene.write_text if text else scene.write_binary)(str(tmp_path))
        if name in refused:
            with pytest.raises(DataError, match=f"camera 7: expected one of .*, got {name}: .*image_undistorter"):
                read_cameras(path)
        else:
            assert read_cameras(path) == {7: (name, 48, 32, tuple(camera.params))}


@pytest.mark.parametrize(("number", "name"), [(99, "number 99"), (-1, "-1")])
def test_camera_models_that_colmap_does_not_have_are_named(tmp_path: Path, number: int, name: str) -> None:
    data = struct.pack("<QIiQQ5d", 1, 3, number, 8, 6, 5.0, 4.0, 3.0, 0.1, 0.0)
    with pytest.raises(DataError, match=name):
        read_cameras(packed(tmp_path, "cameras.bin", data))
