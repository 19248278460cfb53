"""LLFF scenes: `poses_bounds.npy` beside `images/` or `images_k/` (https://github.com/Fyusion/LLFF)."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from kgs._support.errors import DataError
from kgs.datasets.folders import find_models, image_folder, list_images
from kgs.datasets.frames import Frame, FrameSet, PointCloud, check_rotation, path_inside
from kgs.datasets.image_file import ImageFile
from kgs.datasets.images import Intrinsics

from .colmap import largest_model, track_points
from .colmap_poses import registered_images


def load(root: Path, photo_folder: str = "") -> FrameSet:
    """Read `poses_bounds.npy`, one row per image in the order of the names in `images/` or else `images_k/`.

    Convention:
        A row is a 3x5 matrix and two depths, which are not used. Its columns are the camera's down, right and
        backward axes and its centre in the world, then height, width and focal length in pixels; the principal point
        is the image's centre. The focal length is scaled to the images that are read.
    """
    source = root / "poses_bounds.npy"
    folder = image_folder(root, photo_folder)
    rows = _read_rows(source)
    if folder is None:
        raise DataError(root, "", "the photos in images/ or images_k/", "neither folder")
    paths = [path_inside(source, root, path.name, folder) for path in list_images(folder)]
    if len(paths) != len(rows):
        raise DataError(source, "", f"{len(paths)} poses, for the images of {folder.name}/", len(rows))
    frames = [_frame(source, path, row) for path, row in zip(paths, rows, strict=True)]
    if not find_models(root):
        return FrameSet(frames)
    model, notes = largest_model(root)
    return FrameSet(frames, model_points=partial(_model_points, model, frames), notes=notes)


def _read_rows(path: Path) -> NDArray[np.float64]:
    """The rows `(N, 17)`; the file is memory-mapped first, which checks its size before anything is allocated."""
    try:
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # numpy parses the header as Python source: damaged bytes raise whatever that raises
        raise DataError(path, "", "an array that NumPy can read", advice=str(error)) from error
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind != "f":
        got = f"{rows.dtype} {rows.shape}" if isinstance(rows, np.ndarray) else type(rows).__name__
        raise DataError(path, "", "floating point numbers of shape (N, 17)", got)
    rows = np.array(rows, dtype=np.float64)
    infinite = ~np.isfinite(rows[:, :15]).all(axis=1)
    no_size = (rows[:, [4, 9]] < 1).any(axis=1) | (rows[:, [4, 9]] % 1).any(axis=1)
    for name, wrong in (("finite numbers", infinite), ("a height and width of whole pixels", no_size)):
        if wrong.any():
            raise DataError(path, f"row {int(wrong.argmax())}", name)
    return rows


def _frame(source: Path, path: Path, row: NDArray[np.float64]) -> Frame:
    matrix = row[:15].reshape(3, 5)
    check_rotation(source, path.name, torch.from_numpy(matrix))
    down, right, backward, center, (height, width, focal) = matrix.T
    pose = np.vstack([np.stack([right, down, -backward, center], axis=1), [0.0, 0.0, 0.0, 1.0]])
    lens = Intrinsics(int(width), int(height), focal, focal, width / 2, height / 2)
    return Frame(source, path.name, ImageFile(path), lens, torch.from_numpy(pose))


def _model_points(folder: Path, frames: Sequence[Frame], train: Sequence[Frame]) -> PointCloud:
    """The points of the COLMAP model that the poses were made from; its images and the photos pair in order of name."""
    registered = registered_images(folder)
    images = list(registered.images.items())
    order = sorted(range(len(images)), key=lambda row: images[row][1].name)
    if len(order) == len(frames):
        given = torch.stack([frame.pose for frame in frames])
        model = torch.stack([registered.poses, registered.own_poses])[:, order]  # LLFF's program reads the latter
        span = (given[:, :3, 3] - given[:, :3, 3].mean(dim=0)).abs().max()
        difference = (given - model).abs().amax(dim=(0, 1))
        if bool((difference[:, :3] < 1e-3).all()) and bool((difference[:, 3] <= 1e-3 * span).all()):
            ids = {frame.name: images[row][0] for row, frame in zip(order, frames, strict=True)}
            return track_points(folder, {ids[frame.name] for frame in train})
    raise DataError(folder, "points", "the poses of the scene, for model-points", "others")
