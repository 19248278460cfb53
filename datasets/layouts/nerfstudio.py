"""Scenes with one `transforms.json`, as nerfstudio and instant-ngp write them.

Source: https://docs.nerf.studio/quickstart/data_conventions.html.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

from kgs.datasets.frames import Frame, build_scene, path_inside, split_frames
from kgs.datasets.images import Intrinsics, read_size
from kgs.datasets.scene import Scene
from kgs.errors import DataError

from .transforms import opencv_pose, read_focal, read_frames, read_number, read_text

__all__ = ["load_nerfstudio"]

_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE = "OPENCV_FISHEYE"


def load_nerfstudio(
    root: Path,
    train_views: int | None = None,
    downscale: float | None = None,
    background: str = "black",
    points: str = "none",
) -> Scene:
    """Load a scene described by `transforms.json`; distorted lenses are undone.

    Convention:
        `transform_matrix` is camera-to-world with OpenGL axes (x right, y up, z backward). A lens's numbers stand in
        the frame or, for all frames, at the top. `applied_transform` is not undone: the world is the file's.

    Args:
        root: the folder with the file.
        train_views: how many views to train on (see `split_by_name`).
        downscale: how many times smaller the images shall be.
        background: "black" or "white", behind transparent images.
        points: "none": the points of the model behind the file are not read.

    Raises:
        DataError: a file is missing or damaged, a lens is of a kind that cannot be undone, or model-points are asked
            for.
        ValueError: train_views is out of range.
    """
    if points == "model-points":
        raise DataError(root, "points", "model-points are not available for transforms.json")
    source = root / "transforms.json"
    data, entries = read_frames(source)
    names = [str(PurePosixPath(read_text(source, "file_path", entry))) for entry in entries]
    paths = [path_inside(source, root, name) for name in names]
    size = next((read_size(path) for path in paths if path.is_file()), (1, 1))
    frames = [
        Frame(source, name, path, _intrinsics(source, entry, data, size), opencv_pose(source, entry))
        for name, path, entry in zip(names, paths, entries, strict=True)
    ]
    train, test = split_frames(root, frames, train_views)
    return build_scene(root, [frames[i] for i in train], [frames[i] for i in test], downscale, background)


def _intrinsics(source: Path, frame: dict[str, Any], data: dict[str, Any], size: tuple[int, ...]) -> Intrinsics:
    """A frame's lens; where the file does not tell the image size, it is that of the first image."""

    def number(key: str, default: float | None = None) -> float:
        return read_number(source, key, frame, data, default=default)

    model = read_text(source, "camera_model", frame, data, default="OPENCV")
    if model not in (*_PERSPECTIVE, _FISHEYE):
        known = ", ".join((*_PERSPECTIVE, _FISHEYE))
        raise DataError(source, "camera_model", f"{model} cannot be read, only {known}")
    width, height = number("w", size[0]), number("h", size[1])
    if not (width.is_integer() and height.is_integer()):
        raise DataError(source, "w, h", f"expected whole numbers of pixels, got {width:g} and {height:g}")
    has_focal = any("fl_x" in item for item in (frame, data))
    fx = number("fl_x") if has_focal else read_focal(source, width, frame, data)
    fisheye = model == _FISHEYE
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return Intrinsics(
        width=int(width),
        height=int(height),
        fx=fx,
        fy=number("fl_y", fx),
        cx=number("cx", width / 2),
        cy=number("cy", height / 2),
        distortion=tuple(number(key, 0.0) for key in keys),
        fisheye=fisheye,
    )
