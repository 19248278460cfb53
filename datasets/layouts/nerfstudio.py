"""Scenes with one `transforms.json`, as nerfstudio and instant-ngp write them, and the reader of such files.

Sources: https://docs.nerf.studio/quickstart/data_conventions.html; instant-ngp's docs/nerf_dataset_tips.md.
"""

import math
import re
from collections import ChainMap
from collections.abc import Iterable, MutableMapping
from pathlib import Path, PurePosixPath
from typing import Any

import kornia.geometry as kg
import torch
from torch import Tensor

from kgs._support.errors import DataError, quantity, quoted
from kgs._support.json_files import is_number, read_json
from kgs.datasets.folders import IMAGE_SUFFIXES
from kgs.datasets.frames import Frame, FrameSet, check_rotation, find_file, path_inside
from kgs.datasets.image_file import ImageFile
from kgs.datasets.images import Intrinsics
from kgs.datasets.masks import Mask

Object = MutableMapping[str, Any]
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE = "OPENCV_FISHEYE"
# The distortion coefficients of Brown-Conrady and of Kannala-Brandt lenses, in OpenCV's order.
_BROWN = ("k1", "k2", "p1", "p2", "k3")
_KANNALA = ("k1", "k2", "k3", "k4")
_COEFFICIENTS = sorted({*_BROWN, *_KANNALA, "k5", "k6"})
# Keys that are used; then keys for sorting, framing and normalising a scene, and for what a tool did to the world.
# The latter change nothing: the world stays that of the file.
_KNOWN = """
    frames file_path mask_path transform_matrix
    camera_model is_fisheye fl_x fl_y camera_angle_x camera_angle_y cx cy w h k1 k2 k3 k4 k5 k6 p1 p2
    aabb aabb_scale render_aabb scale offset up sharpness rotation colmap_im_id camera_id camera_name camera_label
    applied_transform applied_scale orientation_override auto_scale_poses_override
    camera_make camera_serial camera_index lens_make shutter_speed sensor_width sensor_height
    max_resolution center_depth pose_confidence pose_quality
"""
# Keys that describe a camera in words, passed over unless they name a lens that is not perspective.
_DESCRIPTIONS = ("camera_type", "lens_model")
_OTHER_LENS = re.compile(r"(?i)fish|ftheta|latlong|equirect|panoram|spheric|ortho|omni|360|\bvr")
# Other names of the image size, passed over where they say the same.
_SIZES = {"image_width": "w", "image_height": "h", "width": "w", "height": "h"}
# Other keys that may bear on lenses or poses; they are refused, since ignoring them could give wrong cameras.
_GEOMETRY = re.compile(
    r"(?i)angle|fov|focal|^f[lxy](_|$)|^[cdfkps][a-z]?_?\d+$|^[ck][xy]?$|principal|center|distort|radial|tangential|lens|"
    r"camera|fisheye|ftheta|latlong|equirect|panoram|spheric|ortho|omni|projection|skew|shear|aspect|rolling|shutter|"
    r"mask|crop|width|height|resolution|pose|matrix|extrins|intrins|transl|rotat|quat|orient|flip|^from_|axis|axes|"
    r"handed|convention|c2w|w2c"
)


def load(root: Path) -> FrameSet:
    """Read `transforms.json`, see :func:`read_transforms`.

    `applied_transform` is not undone: the world is the file's. Where the file has `test_filenames` (or else
    `val_filenames`), these are the test views; training views are those of `train_filenames`, or all others.
    """
    frames, data, notes = read_transforms(root, "transforms.json")
    lists = {key: _listed(root, data, f"{key}_filenames", frames) for key in ("train", "val", "test")}
    held_out = lists["test"] or lists["val"]
    train = lists["train"] or [frame for frame in frames if frame not in [*lists["val"], *held_out]]
    if lists["train"] and not held_out:
        held_out = [frame for frame in frames if frame not in train]
    if not train or (lists["train"] and not held_out):
        raise DataError(root / "transforms.json", "train_filenames", "views to train on and others to test on")
    if (unused := len(frames) - len(train) - len(held_out)) > 0:
        notes += (f"transforms.json: neither training nor test views: {quantity(unused, 'frame')}",)
    return FrameSet(train, held_out or None, notes=notes)


def _listed(root: Path, data: Object, key: str, frames: list[Frame]) -> list[Frame]:
    """The frames in the file's list `key` of file names, sorted by name."""
    source = root / "transforms.json"
    names = data.get(key) or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise DataError(source, key, "a list of file names")
    by_name = {frame.name: frame for frame in frames}
    listed = sorted({_find_photo(source, root, name) for name in names})
    if unknown := [name for name in listed if name not in by_name]:
        raise DataError(source, key, "names of frames", quoted(unknown[0]))
    return [by_name[name] for name in listed]


def read_transforms(root: Path, name: str) -> tuple[list[Frame], Object, tuple[str, ...]]:
    """The frames of such a file, at least one; the whole object; notes about what is not used.

    Convention:
        `transform_matrix` is camera-to-world with OpenGL axes (x right, y up, z backward). A lens's numbers are in
        the frame or, for all frames, at the top level; `camera_angle_x` and `_y` are fields of view, used if there is
        no `fl_x` or `fl_y`. By default pixels are square, the lens is centred, and its size is the first photo's.

    A DataError if the file cannot be read, lacks a field, or has entries about lenses or poses that cannot be used.
    """
    data = read_json(source := root / name, finite=False)  # `is_number` refuses what is not finite, where it is used
    entries = data.get("frames")
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise DataError(source, "frames", "a list of objects, not empty")
    split = {f"{part}_filenames" for part in ("train", "val", "test")} if name == "transforms.json" else set[str]()
    top = {key: data[key] for key in data.keys() - split}
    values = [_Values(source, entry, data) for entry in entries]
    notes = _check_keys(source, [_Values(source, top), *values])
    names = [_find_photo(source, root, _Values(source, entry).text("file_path")) for entry in entries]
    images = [ImageFile(find_file(source, root, name)) for name in names]
    size = (1, 1)  # where no photo is there `load_scene` refuses the scene
    if not all("w" in of_frame and "h" in of_frame for of_frame in values):
        for image in (image for image in images if image.path.is_file()):
            image.load()  # its pixels will be decoded later: the file is not opened again for them
            size = image.size
            break
    frames = []
    for name, image, of_frame in zip(names, images, values, strict=True):
        lens = _lens(of_frame, size)
        mask = of_frame.text("mask_path", "")
        if mask and not (path := find_file(source, root, mask)).is_file():
            raise of_frame.wrong("mask_path", "a file", f"{mask[:200]!r}, which is not there")
        pose = _opencv_pose(source, of_frame.maps[0])
        frames.append(Frame(source, name, image, lens, pose, Mask(path) if mask else None))
    return frames, data, notes


class _Values(ChainMap[str, Any]):
    """What holds for a frame: its own entries, then those of the whole file."""

    def __init__(self, source: Path, *objects: Object) -> None:
        super().__init__(*objects)
        self.source = source

    def number(self, key: str, default: float | None = None) -> float:
        if not is_number(value := self.get(key, default)):
            raise self.wrong(key, "a finite number", _shown(value))
        return float(value)

    def text(self, key: str, default: str | None = None) -> str:
        if not isinstance(value := self.get(key, default), str):
            raise self.wrong(key, "a text", _shown(value))
        return value

    def wrong(self, key: str, expected: str, got: object) -> DataError:
        """The error about an entry, which names the photo of the frame unless it holds for all."""
        own = self.maps[0]
        name = own.get("file_path")
        of_photo = f" of {name[:200]}" if key in own and key != "file_path" and isinstance(name, str) else ""
        return DataError(self.source, f"{key[:60]}{of_photo}", expected, got)


def _find_photo(source: Path, root: Path, name: str) -> str:
    """The name of a photo within the scene's folder: as given, or with the ending that the file has."""
    name = str(PurePosixPath(name.replace("\\", "/")))
    candidates = [name, *(name + ending for suffix in IMAGE_SUFFIXES for ending in (suffix, suffix.upper()))]
    otherwise = name if PurePosixPath(name).suffix else f"{name}.png"
    return next((candidate for candidate in candidates if path_inside(source, root, candidate).is_file()), otherwise)


def _check_keys(source: Path, objects: Iterable[_Values]) -> tuple[str, ...]:
    """Refuse unknown keys that bear on lenses or poses; returns a note about the other unknown keys."""
    known = set(_KNOWN.split())
    unused = set()
    for values in objects:
        for key, value in values.maps[0].items():
            if key in known or _is_empty(value):
                continue
            if key in _DESCRIPTIONS and isinstance(value, str) and not _OTHER_LENS.search(value):
                continue
            if key in _SIZES and is_number(value) and value == values.get(_SIZES[key]):
                continue
            if _GEOMETRY.search(key) or key.endswith("_filenames"):
                raise values.wrong(key, "none, 0 or false, kgs cannot use it", _shown(value))
            unused.add(key[:60])
    return (f"{source.name}: not used: {', '.join(sorted(unused)[:20])}",) if unused else ()


def _is_empty(value: Any) -> bool:
    return all(map(_is_empty, value)) if isinstance(value, list) else not value


def _lens(values: _Values, size: tuple[int, ...]) -> Intrinsics:
    """A frame's lens; `size` is the image size if the file does not give it."""
    fisheye = _is_fisheye(values)
    width = values.number("w", size[0])
    height = values.number("h", size[1])
    if not (width.is_integer() and height.is_integer()):
        raise DataError(values.source, "w, h", "whole numbers of pixels", f"{width:g} and {height:g}")
    fx = _focal("x", values, width)
    fy = _focal("y", values, height)
    fx = fy if fx is None else fx
    fy = fx if fy is None else fy
    if fx is None or fy is None:
        raise DataError(values.source, "fl_x, camera_angle_x", "one of them", "none")
    used = _KANNALA if fisheye else _BROWN
    frame = values.maps[0]
    of_this_lens = _Values(values.source, frame) if {"camera_model", "is_fisheye"} & frame.keys() else values
    for key in _COEFFICIENTS:
        if key not in used and (value := of_this_lens.number(key, 0.0)) != 0:
            kind = "a fisheye lens" if fisheye else "a lens that is not a fisheye, where tools disagree on its meaning"
            raise values.wrong(key, f"0 for {kind}", f"{value:g}")
    distortion = tuple(values.number(key, 0.0) for key in used)
    cx = values.number("cx", width / 2)
    cy = values.number("cy", height / 2)
    return Intrinsics(int(width), int(height), fx, fy, cx, cy, distortion, fisheye)


def _is_fisheye(values: _Values) -> bool:
    """Whether the lens is a fisheye: nerfstudio names the model in `camera_model`, instant-ngp has `is_fisheye`."""
    model = values.text("camera_model", "")
    flag = values.get("is_fisheye")
    known = (*_PERSPECTIVE, _FISHEYE)
    if "camera_make" in values and model not in known and not _OTHER_LENS.search(model):
        model = ""  # of the device, as in Exif
    if model not in ("", *known):
        raise values.wrong("camera_model", f"one of {', '.join(known)}", quoted(model))
    if flag is not None and not (isinstance(flag, int) and flag in (0, 1)):
        raise values.wrong("is_fisheye", "true or false", _shown(flag))
    if flag is not None and model and bool(flag) != (model == _FISHEYE):
        raise values.wrong("is_fisheye", f"that of camera_model, {model}", str(bool(flag)).lower())
    return bool(flag) or model == _FISHEYE


def _focal(axis: str, values: _Values, length: float) -> float | None:
    """The focal length in pixels along an axis, from `fl_` or else from the field of view over `length`; or None."""
    for item in values.maps:
        if f"fl_{axis}" in item:
            return values.number(f"fl_{axis}")
        if (key := f"camera_angle_{axis}") in item:
            angle = values.number(key)
            if not 0 < angle / 2 < math.pi / 2:
                raise values.wrong(key, "an angle between 0 and pi", f"{angle:g}")
            return length / (2 * math.tan(angle / 2))
    return None


def _shown(value: Any) -> str:
    return "none" if value is None else quoted(value)


def _opencv_pose(path: Path, frame: Object) -> Tensor:
    """A frame's `transform_matrix`, 4x4 or 3x4, as camera-to-world with OpenCV axes, `(4, 4)` float64."""
    rows = frame.get("transform_matrix")
    name = f"transform_matrix of {str(frame.get('file_path'))[:200]}"
    expected = "a 4x4 matrix of finite numbers"
    rows = rows if isinstance(rows, list) and all(isinstance(row, list) and len(row) == 4 for row in rows) else []
    rows = [*rows, [0, 0, 0, 1]] if len(rows) == 3 else rows
    if len(rows) != 4:
        raise DataError(path, name, expected)
    if wrong := [x for row in rows for x in row if not is_number(x)]:
        raise DataError(path, name, expected, _shown(wrong[0]))
    matrix = torch.tensor([[float(x) for x in row] for row in rows], dtype=torch.float64)[None]
    last = matrix.new_tensor([0.0, 0.0, 0.0, 1.0])
    if float((matrix[0, 3] - last).abs().max()) > 1e-6:  # an inverse is off by rounding
        raise DataError(path, name, "the last row 0, 0, 0, 1", matrix[0, 3].tolist())
    matrix[0, 3] = last
    check_rotation(path, name, matrix[0])
    return kg.camtoworld_graphics_to_vision_4x4(matrix)[0]
