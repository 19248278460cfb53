"""Files of a scene that are wrong: the error names the file, and what in it.

One table a layout: the file, what is changed in it, and how the error begins, relative to the scene's folder.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import pytest
from tiny_scenes import update_json, write_blender, write_colmap, write_llff, write_nerfstudio

from kgs._support.errors import DataError
from kgs.datasets import load_scene

Change = Callable[[Path], object]


def text(old: str, new: str) -> Change:
    """The first match of a regular expression is replaced."""

    def change(path: Path) -> None:
        changed, count = re.subn(old, new, path.read_text(), count=1)
        assert count == 1
        path.write_text(changed)

    return change


def content(data: bytes) -> Change:
    return lambda path: path.write_bytes(data)


def top(**values: Any) -> Change:
    return lambda path: update_json(path, **values)


def frame(**values: Any) -> Change:
    """Keys of the last frame."""
    return lambda path: update_json(path, 2, **values)


def pose(*index: Any, value: float) -> Change:
    matrix = np.eye(4)
    matrix[index] = value
    return frame(transform_matrix=matrix.tolist())


def array(of: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda path: np.save(path, of(np.load(path)))


def row(column: int, value: float) -> Change:
    """A number of the second row."""

    def change(path: Path) -> None:
        rows = np.load(path)
        rows[1, column] = value
        np.save(path, rows)

    return change


def npy(shape: str, kind: str = "<f8") -> Change:
    """A header of a NumPy file, and too few or other data."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return content(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + bytes(136))


def picture(height: int, width: int, kept_bytes: int | None = None, black: bool = False) -> Change:
    """White on the right, unless it is all black."""
    image = np.zeros((height, width), np.uint8)
    image[:, width // 2 :] = 0 if black else 255

    def change(path: Path) -> None:
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), image)
        path.write_bytes(path.read_bytes()[:kept_bytes])

    return change


def not_finite(key: str, change: Callable[..., Change]) -> list[Change]:
    """What Python's JSON, and other programs, write for numbers that are not finite."""

    def written(as_text: str) -> Change:
        def both(path: Path) -> None:
            change(**{key: 1234.5})(path)
            text("1234.5", as_text)(path)

        return both

    return [written(as_text) for as_text in ("-Infinity", "Infinity", "NaN", "1e999")]


def gone(path: Path) -> None:
    """As well as another photo: more than half of them."""
    path.unlink()
    path.with_name("2.png").unlink()


def sideways(path: Path) -> None:
    """As a phone stores an upright photo, its size in the scene's file being that of the upright one."""
    exif = PIL.Image.Exif()
    exif[0x112] = 6
    PIL.Image.new("RGB", (12, 16)).save(path, exif=exif)


POSES = "poses_bounds.npy"
LLFF = [
    *[
        (POSES, array(change), f"{POSES}: expected floating")
        for change in (lambda rows: rows[:, :16], lambda rows: rows[0], lambda rows: rows.astype(np.int64))
    ],
    (POSES, array(lambda rows: rows[:2]), f"{POSES}: expected 3 poses"),
    *[(POSES, row(*cell), f"{POSES}: row 1") for cell in ((2, np.nan), (4, 12.5), (4, 0))],
    (POSES, row(14, -80), f"{POSES}: 1.png"),
    (POSES, row(0, 0.7), f"{POSES}: 1.png"),
    (POSES, row(9, 60), "images/1.png: "),
    *[
        (POSES, npy(shape), f"{POSES}: ")
        for shape in ("(3000000000000, 17)", "(18446744073709551616, 17)", "(-5, 17)", "(2, 17)", "(1, 17")
    ],
    (POSES, npy("(1, 17)", "|O"), f"{POSES}: "),
    (POSES, content(b"PK\x03\x04 no zip"), f"{POSES}: "),
    ("masks/9.png", picture(12, 16), "masks: "),
    ("masks/0.png", picture(12, 10), "masks/0.png: "),
    ("masks/0.png", picture(12, 16, black=True), "masks/0.png: "),
    ("masks/0.png", picture(12, 16, kept_bytes=40), "masks/0.png: "),
    ("masks/0.jpg", lambda path: [picture(12, 16)(path.with_suffix(end)) for end in (".jpg", ".png")], "masks/0.png: "),
]
MODEL, CAMERAS, IMAGES, RIGS, FRAMES, POINTS = (
    f"sparse/0{name}" for name in ("", "/cameras.txt", "/images.txt", "/rigs.txt", "/frames.txt", "/points3D.txt")
)
COLMAP = [
    (CAMERAS, text("OPENCV", "FOV"), f"{CAMERAS}: camera 1"),
    (CAMERAS, text(" 14.0 14.5 ", " 14.0 "), f"{CAMERAS}: camera 1"),
    (CAMERAS, text(" 14.0 14.5 ", " fourteen 14.5 "), f"{CAMERAS}: camera 1: "),
    (CAMERAS, text(" 14.0 14.5 ", " -14 14.5 "), f"{IMAGES}: 0.png"),
    (CAMERAS, text(" 14.0 14.5 ", " nan 14.5 "), f"{IMAGES}: 0.png"),
    (CAMERAS, text(" 0.001 -0.001", " 0.001 inf"), f"{IMAGES}: 0.png"),
    (CAMERAS, text("\n1 ", "\n8 "), f"{IMAGES}: 0.png: expected a camera of cameras.txt, got 1"),
    (CAMERAS, text("\n1 ", "\n2 "), f"{CAMERAS}: camera 2"),
    (CAMERAS, content(b"\xe9"), f"{CAMERAS}: "),
    (IMAGES, text(" 1 2.png", " 1 ../2.png"), f"{IMAGES}: '../2.png'"),
    (IMAGES, text(" 1 2.png", " 1 0.png"), f"{IMAGES}: 0.png: expected each image once"),
    (IMAGES, text(" 1 2.png", " one 2.png"), f"{IMAGES}: image: "),
    (IMAGES, text("\n3 ", "\n2 "), f"{IMAGES}: image 2"),
    (IMAGES, text(r"\n3 \S+ \S+ \S+ \S+ ", "\n3 0 0 0 0 "), f"{IMAGES}: 2.png"),
    (IMAGES, text(r"\n3 \S+", "\n3 nan"), f"{IMAGES}: 2.png"),
    (POINTS, text(" 0.1 ", " nan "), f"{POINTS}: "),
    (POINTS, text(" 255 ", " 256 "), f"{POINTS}: "),
    (POINTS, text(" 0.1 ", " 1e16 "), ": points: "),
    *[(POINTS, text(r" 0\.5 .*\n8(.*) 0\.5.*", rf"{tracks}\n8\1{tracks}"), f"{POINTS}: ") for tracks in (" 0.5", " x")],
    (FRAMES, text(r"\n3 5.*", ""), f"{FRAMES}: 2.png"),
    (FRAMES, text(r"(?s).*", "# none"), f"{FRAMES}: 0.png"),
    (FRAMES, text("CAMERA 1 1", "CAMERA 1 3"), f"{FRAMES}: 2.png: expected each image in one"),
    (FRAMES, text("\n3 5", "\n3 4"), f"{FRAMES}: frame 3"),
    (FRAMES, text("\n3 ", "\n2 "), f"{FRAMES}: frame 2"),
    (FRAMES, text(r"\n3 5 \S+ \S+ \S+ \S+", r"\n3 5 0 0 0 0"), f"{FRAMES}: frame 3"),
    (FRAMES, text(r"\n3 5 \S+", r"\n3 5 nan"), f"{FRAMES}: frame 3"),
    (FRAMES, text(r"\n3 5 \S+", r"\n3 5 x"), f"{FRAMES}: frame: "),
    (FRAMES, text("CAMERA 1 3", "LIDAR 1 3"), f"{FRAMES}: 2.png"),
    (FRAMES, text("CAMERA 1 3", "CAMERA 1"), f"{FRAMES}: frame 3"),
    (FRAMES, text("CAMERA 1 3", "CAMERA 1 3 8"), f"{FRAMES}: line '3 5"),
    (FRAMES, text("1 CAMERA 1 3", "999999999 CAMERA 1 3"), f"{FRAMES}: frame 3"),
    (RIGS, text(r"CAMERA 2 1 .*", "CAMERA 2 0"), f"{RIGS}: 1.png"),
    (RIGS, text(r"5 2 CAMERA 1 .*", "5 1 CAMERA 1"), f"{RIGS}: 1.png"),
    (RIGS, text(r"5 2 CAMERA 1 .*", "5 2 CAMERA 1 CAMERA 1 0"), f"{RIGS}: rig 5: camera 1"),
    (RIGS, text(r"CAMERA 2 1 \S+", "CAMERA 2 1 inf"), f"{RIGS}: rig 5"),
    ("images/1.png", picture(16, 12), "images/1.png: "),
    ("images/1.png", gone, ": expected 3 images, got 1: there is no images/1.png, images/2.png"),
]
NERFSTUDIO_FILE = "transforms.json"
TRAIN = "transforms_train.json"
THIRD_POSE = "transform_matrix of ./train/2"
UNUSABLE: list[tuple[str, Any]] = [
    ("k4", 0.1),  # nerfstudio: the fourth radial term; OpenCV: a denominator
    ("k6", -0.1),
    ("ftheta_p0", 0.3),
    ("equirectangular", True),
    ("latlong", True),
    ("orthographic", 1),
    ("rolling_shutter", [0, 0, 0.1, 0]),
    ("distortion_params", [0.1, 0, 0, 0, 0, 0]),
    ("fisheye_crop_radius", 12.0),
    ("x_fov", 40),
    ("focal_length", 50),
    ("principal_point_x", 20),
    ("lens_mode", "ftheta"),
    ("skew", 0.1),
    ("from_na", True),
    ("is_fisheye", "yes"),
    ("is_fisheye", True),  # but camera_model is OPENCV
    *[("camera_model", model) for model in ("EQUIRECTANGULAR", "FISHEYE624", "ORTHOPHOTO", "OMNIDIRECTIONALSTEREO_L")],
    *[("camera_model", model) for model in ("VR180_R", "SIMPLE_FISHEYE", "FULL_OPENCV", 3)],
    ("k1", "0.1"),
    ("k1", [0.1]),
    ("fl_y", "50"),
    ("camera_type", "EQUIRECTANGULAR"),
    ("camera_type", "orthographic"),
    ("camera_type", 3),
    ("lens_model", "fisheye"),
    ("image_width", 17),
    ("height", 24),
    ("width", True),
    ("cx", None),
    ("mask_path", 3),
    ("mask_path", "masks/none.png"),
]
EITHER_LAYOUT = [
    *[(top(**{key: value}), f": {key}") for key, value in UNUSABLE],
    *[(frame(**{key: value}), f": {key} of images/2.png") for key, value in UNUSABLE],
    *[
        (change, f": {key}{whose}")
        for key in ("fl_x", "cx", "w", "k1", "k5", "skew")
        for where, whose in ((top, ": "), (frame, " of images/2.png: "))
        for change in not_finite(key, where)
    ],
]
NERFSTUDIO = [
    *[(NERFSTUDIO_FILE, change, NERFSTUDIO_FILE + said) for change, said in EITHER_LAYOUT],
    *[
        (NERFSTUDIO_FILE, change(**{key: -50.0}), f"{NERFSTUDIO_FILE}: images/{photo}.png")
        for key in ("fl_x", "fl_y")
        for change, photo in ((top, 0), (frame, 2))
    ],
    *[
        (NERFSTUDIO_FILE, top(**said), f"{NERFSTUDIO_FILE}: {where}")
        for said, where in [
            ({"camera_make": "Insta360", "camera_model": "EQUIRECTANGULAR"}, "camera_model"),
            ({"fl_x": 0}, "images/0.png"),
            ({"fl_x": 0.9, "fl_y": 1.2, "cx": 0.5, "cy": 0.5}, "images/0.png"),  # shares of the sides
            ({"fl_x": None, "fl_y": None}, "fl_x"),
            ({"w": 16.5}, "w, h"),
            ({"w": 0}, "images/0.png"),
            ({"k1": -4.0}, "distortion of images/2.png"),
            ({"train_filenames": ["images/0.png"], "test_filenames": ["images/0.png"]}, "images/0.png"),
            ({"train_filenames": ["images/9.png"]}, "train_filenames"),
            ({"test_filenames": "images/0.png"}, "test_filenames"),
            ({"test_filenames": [3]}, "test_filenames"),
            ({"train_filenames": [f"images/{i}.png" for i in range(3)]}, "train_filenames"),
            ({"test_filenames": [f"images/{i}.png" for i in range(3)]}, "train_filenames"),
            ({"test_filenames": ["../0.png"]}, "'../0.png'"),
        ]
    ],
    (NERFSTUDIO_FILE, top(w=12, h=16), "images/1.png: "),
    ("images/1.png", sideways, "images/1.png: expected a scaled version of the 16x12 that"),
    (NERFSTUDIO_FILE, frame(camera_model="OPENCV_FISHEYE", is_fisheye=False), f"{NERFSTUDIO_FILE}: is_fisheye of"),
    (NERFSTUDIO_FILE, frame(camera_model="OPENCV_FISHEYE", p1=0.01), f"{NERFSTUDIO_FILE}: p1 of images/2.png"),
]
NO_OBJECTS = ["", "{", "[]", "{}", '{"frames": []}', '{"frames": [3]}', "[" * 100_000]
BLENDER = [
    *[(TRAIN, top(**{key: value}), f"{TRAIN}: {key}") for key, value in UNUSABLE[:3]],
    *[(TRAIN, top(camera_angle_x=angle), f"{TRAIN}: camera_angle_x") for angle in (3.2, "wide", None, True)],
    *[(TRAIN, change, f"{TRAIN}: camera_angle_x") for change in not_finite("camera_angle_x", top)],
    *[(TRAIN, change, f"{TRAIN}: camera_angle_y") for change in not_finite("camera_angle_y", top)],
    (TRAIN, frame(file_path="../../etc/passwd"), f"{TRAIN}: '../../etc/passwd'"),
    (TRAIN, frame(file_path=7), f"{TRAIN}: file_path"),
    (TRAIN, frame(file_path="train/1"), f"{TRAIN}: train/1.png"),
    (TRAIN, frame(file_path="train/77"), ": expected 6 images, got 5: there is no train/77.png"),
    *[
        (TRAIN, change, f"{TRAIN}: {THIRD_POSE}")
        for change in (
            frame(transform_matrix=[[1, 0], [0, 1]]),
            frame(transform_matrix=None),
            pose(3, 3, value=2.0),
            frame(transform_matrix=[[10**400, 0, 0, 0], *np.eye(4).tolist()[1:]]),
            *not_finite("transform_matrix", lambda transform_matrix: pose(0, 3, value=transform_matrix)),
        )
    ],
    (
        TRAIN,
        pose([0, 1, 2], [0, 1, 2], value=1.01),
        f"{TRAIN}: {THIRD_POSE}: expected a rotation, got one scaled by 1.01: ",
    ),
    (TRAIN, pose(0, 1, value=0.25), f"{TRAIN}: {THIRD_POSE}: expected a right-handed rotation, got [[1.0, 0.25, 0.0]"),
    (TRAIN, pose(2, 2, value=-1.0), f"{TRAIN}: {THIRD_POSE}: expected a right-handed rotation"),
    *[(TRAIN, content(written.encode()), f"{TRAIN}: ") for written in NO_OBJECTS],
    (TRAIN, content(b"\xff"), f"{TRAIN}: "),
    ("masks/0.png", picture(12, 16), "masks/0.png: "),  # of which of two photos?
]
SCENES: dict[str, tuple[Callable[[Path], None], list[tuple[str, Change, str]]]] = {
    "LLFF": (write_llff, LLFF),
    "COLMAP": (lambda root: write_colmap(root, text=True, rig=True), COLMAP),
    "Blender": (write_blender, BLENDER),
    "nerfstudio": (write_nerfstudio, NERFSTUDIO),
}


@pytest.mark.parametrize(
    ("layout", "file", "change", "said"),
    [(layout, *case) for layout, (_, cases) in SCENES.items() for case in cases],
)
def test_the_error_names_the_file_and_what_in_it(
    tmp_path: Path, layout: str, file: str, change: Change, said: str
) -> None:
    SCENES[layout][0](tmp_path)
    change(tmp_path / file)
    with pytest.raises(DataError) as error:
        load_scene(tmp_path, points="model-points" if layout == "COLMAP" else "none")
    assert str(error.value).removeprefix(str(tmp_path)).removeprefix("/").startswith(said)
    assert ("Exif" in str(error.value)) == (change is sideways)
