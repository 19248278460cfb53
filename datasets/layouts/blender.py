"""NeRF's synthetic scenes: `transforms_train.json`, `transforms_test.json` and RGBA renderings.

Source: Mildenhall et al., NeRF (ECCV 2020); the eight training frames are those of DietNeRF and its followers.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import torch

from kgs.datasets.frames import Frame, PointCloud, build_scene, check_unique, path_inside
from kgs.datasets.images import Intrinsics, read_size
from kgs.datasets.scene import Scene
from kgs.datasets.splits import BLENDER_TRAIN_FRAMES, select_evenly
from kgs.errors import DataError

from .transforms import opencv_pose, read_focal, read_frames, read_text

__all__ = ["load_blender"]

_RANDOM_POINTS = 10_000


def load_blender(
    root: Path,
    train_views: int | None = None,
    downscale: float | None = None,
    background: str = "black",
    points: str = "none",
) -> Scene:
    """Load a synthetic scene: its renderings on a background, and random first points in [-1, 1]^3.

    Convention:
        `transform_matrix` is camera-to-world with OpenGL axes (x right, y up, z backward); `camera_angle_x` is the
        horizontal field of view of a centred lens with square pixels.

    Args:
        root: the folder with the two json files.
        train_views: how many frames of the training file to use: 8 gives the published ones (2, 16, 26, 55, 73, 76,
            86, 93 in the file's order), any other number even spacing, None all. All test frames are test views.
        downscale: how many times smaller the images shall be.
        background: "black" or "white".
        points: "none": there is no model with points; the random ones come always.

    Raises:
        DataError: a file is missing or damaged, or model-points are asked for.
        ValueError: train_views is out of range.
    """
    if points == "model-points":
        raise DataError(root, "points", "model-points are not available: a Blender scene has no points")
    train, test = _frames(root, "train"), _frames(root, "test")
    chosen = select_evenly(len(train), train_views)
    if train_views == len(BLENDER_TRAIN_FRAMES) and len(train) > max(BLENDER_TRAIN_FRAMES):
        chosen = list(BLENDER_TRAIN_FRAMES)
    return build_scene(root, [train[i] for i in chosen], test, downscale, background, _random_points())


def _frames(root: Path, split: str) -> list[Frame]:
    source = root / f"transforms_{split}.json"
    data, entries = read_frames(source)
    names = [str(PurePosixPath(read_text(source, "file_path", entry))) for entry in entries]
    names = [name if PurePosixPath(name).suffix == ".png" else f"{name}.png" for name in names]
    paths = [path_inside(source, root, name) for name in names]
    width, height = next((read_size(path) for path in paths if path.is_file()), (1, 1))
    focal = read_focal(source, width, data)
    lens = Intrinsics(width, height, focal, focal, width / 2, height / 2)
    frames = [
        Frame(source, name, path, lens, opencv_pose(source, entry))
        for name, path, entry in zip(names, paths, entries, strict=True)
    ]
    check_unique(frames)
    return frames


def _random_points() -> PointCloud:
    """Uniform in the cube that holds the objects, of a colour near grey; the same ones each time."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(_RANDOM_POINTS, 3, generator=generator, dtype=torch.float64) * 2 - 1
    colors = 0.45 + 0.1 * torch.rand(_RANDOM_POINTS, 3, generator=generator)
    return PointCloud(points, colors, "random")
