"""Poses of COLMAP models with rigs and frames, compared with what pycolmap reads, also where files disagree."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from posed_scenes import HEIGHT, WIDTH, poses, write_photo
from refusals import refused

from kgs._support.errors import DataError
from kgs.datasets import load_scene
from kgs.datasets.layouts.colmap_poses import registered_images

FRAMES = 4
BOTH = pytest.mark.parametrize("text", [False, True])
# The second camera's pose from the rig, which is where the first camera is.
TURN = np.array([0.0, 0.1, 0.02, 0.99]) / np.linalg.norm([0.0, 0.1, 0.02, 0.99])  # x, y, z, w
SHIFT = np.array([0.3, 0.1, -0.05])


def write_rig(folder: Path, text: bool, seed: int = 0) -> Any:
    """As pycolmap writes it: two cameras on a rig, which stands in four places; image 10 + i is img{i}.png."""
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap writes the models")
    scene = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=3)
    for camera_id in (1, 2):
        params = [40.0 + camera_id, 40.0, WIDTH / 2, HEIGHT / 2]
        camera = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=params, camera_id=camera_id)
        scene.add_camera(camera)
        if camera_id == 1:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(pycolmap.Rotation3d(TURN), SHIFT))
    scene.add_rig(rig)
    for i in range(FRAMES):
        rotation, translation = poses(seed)[i]
        frame = pycolmap.Frame(frame_id=20 + i, rig_id=3)
        images = []
        for k in range(2):
            number = 2 * i + k
            images.append(pycolmap.Image(name=f"img{number}.png", camera_id=k + 1, image_id=10 + number))
            images[-1].frame_id = 20 + i
            frame.add_data_id(images[-1].data_id)
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
        scene.add_frame(frame)
        for image in images:
            scene.add_image(image)
    folder.mkdir(parents=True)
    (scene.write_text if text else scene.write_binary)(str(folder))
    return scene


def write_stale(root: Path, text: bool) -> Path:
    """A model whose images.* have the poses of another one; returns its folder."""
    model = root / "sparse" / "0"
    write_rig(model, text)
    write_rig(root / "other", text, seed=5)
    name = "images.txt" if text else "images.bin"
    shutil.copy(root / "other" / name, model / name)
    shutil.rmtree(root / "other")
    return model


def read_by_pycolmap(folder: Path) -> dict[int, np.ndarray]:
    """Poses from world to camera, by the image's id."""
    pycolmap = pytest.importorskip("pycolmap")
    scene = pycolmap.Reconstruction(str(folder))
    return {image_id: image.cam_from_world().matrix() for image_id, image in scene.images.items()}


def check_poses(folder: Path) -> None:
    """Compare with pycolmap."""
    registered = registered_images(folder)
    expected = read_by_pycolmap(folder)
    assert sorted(registered.images) == sorted(expected)
    for image_id, pose in zip(registered.images, registered.poses, strict=True):
        np.testing.assert_allclose(pose.inverse()[:3], expected[image_id], atol=1e-9)


@BOTH
def test_a_rig_of_two_cameras(tmp_path: Path, text: bool) -> None:
    write_rig(tmp_path / "a", text)
    check_poses(tmp_path / "a")
    registered = registered_images(tmp_path / "a")
    assert registered.notes == ()
    np.testing.assert_allclose(registered.poses, registered.own_poses, atol=1e-9)


@BOTH
def test_frames_and_rigs_say_more_than_images(tmp_path: Path, text: bool) -> None:
    model = write_stale(tmp_path, text)
    check_poses(model)
    registered = registered_images(model)
    assert float((registered.poses - registered.own_poses)[:, :3, 3].abs().max()) > 0.1
    for i in range(2 * FRAMES):
        write_photo(tmp_path / "images" / f"img{i}.png", i)
    scene = load_scene(tmp_path, hold_out=0)
    (note,) = scene.notes
    assert "the poses of 8 of 8 photos in images." in note
    assert "frames." in note
    expected = read_by_pycolmap(model)
    for name, extrinsics in zip(scene.train.names, scene.train.cameras.extrinsics.double(), strict=True):
        pose = expected[10 + int(name[3:-4])]
        np.testing.assert_allclose(extrinsics[:3, :3], pose[:, :3], atol=1e-6)
        np.testing.assert_allclose(extrinsics[:3, 3], pose[:, 3] + pose[:, :3] @ scene.offset.numpy(), atol=1e-5)


READABLE = [
    ("frames", "2 CAMERA 1 16 CAMERA 2 17", "3 CAMERA 1 16 CAMERA 2 17 CAMERA 2 99", "txt lacks are left out: 1"),
    ("images", r"\n1[67] .*\n.*\n1[67] .*\n.*", "\n", "photos of frames.txt that images.txt lacks are left out: 2"),
    ("images", r"\n10 .*\n.*", "", "photos of frames.txt that images.txt lacks are left out: 1"),
    ("frames", "2 CAMERA 1 16 CAMERA 2 17", "3 CAMERA 1 16 CAMERA 2 17 IMU 7 17", ""),
    ("rigs", r"3 2 CAMERA 1 (.*)", r"3 4 CAMERA 1 \1 IMU 7 1 1 0 0 0 5 5 5 IMU 2 0", ""),
    ("frames", r"\n23 3 (\S+ \S+ \S+ \S+) \S+", r"\n23 3 \1 0.75", "poses of 2 of 8 photos in images.txt are not used"),
    ("rigs", r"CAMERA 2 1 (.*)", "CAMERA 2 1 1 0 0 0 0 0 1", "poses of 4 of 8 photos in images.txt are not used"),
    ("rigs", r"(?s).*", "# none\n", ""),  # with empty frames: as older versions write them
]


@pytest.mark.parametrize(("file", "old", "new", "note"), READABLE)
def test_texts_that_pycolmap_reads(tmp_path: Path, file: str, old: str, new: str, note: str) -> None:
    write_rig(tmp_path / "a", text=True)
    change(tmp_path / "a" / f"{file}.txt", old, new)
    if old == "(?s).*":
        (tmp_path / "a" / "frames.txt").write_text("")
    check_poses(tmp_path / "a")
    notes = registered_images(tmp_path / "a").notes
    assert len(notes) == bool(note)
    assert note in "".join(notes)


def change(path: Path, old: str, new: str) -> None:
    text, count = re.subn(old, new, path.read_text(), count=1)
    assert count
    path.write_text(text)


@BOTH
@pytest.mark.parametrize(("gone", "left"), [("frames", "rigs"), ("rigs", "frames")])
def test_one_of_both_alone_is_not_used(tmp_path: Path, gone: str, left: str, text: bool) -> None:
    write_rig(tmp_path / "a", text)
    suffix = "txt" if text else "bin"
    (tmp_path / "a" / f"{gone}.{suffix}").unlink()
    registered = registered_images(tmp_path / "a")
    assert registered.notes == (f"{left}.{suffix} is not used: there is no {gone}.{suffix} beside it",)
    assert registered.poses.equal(registered.own_poses)


def test_another_camera_in_a_frame_is_refused(tmp_path: Path) -> None:
    write_rig(tmp_path / "a", text=True)
    change(tmp_path / "a" / "images.txt", " 1 img6", " 2 img6")
    with refused(DataError, path=tmp_path / "a" / "frames.txt", key="img6.png"):
        registered_images(tmp_path / "a")


@pytest.mark.parametrize(
    ("left_out", "used"), [("", "images.bin"), ("points3D.bin", "images.txt"), ("cameras.bin", "images.txt")]
)
def test_of_two_formats_the_one_that_colmap_reads(tmp_path: Path, left_out: str, used: str) -> None:
    write_rig(tmp_path / "a", text=False)
    write_rig(tmp_path / "b", text=True, seed=5)
    for path in (tmp_path / "b").iterdir():
        shutil.copy(path, tmp_path / "a")
    if left_out:
        (tmp_path / "a" / left_out).unlink()
    check_poses(tmp_path / "a")
    (note,) = registered_images(tmp_path / "a").notes
    other = "txt" if used.endswith("bin") else "bin"
    assert re.search(rf"images\.{other}, .*frames\.{other}, rigs\.{other}; the model is read from {used}", note)
