"""`load_scene`: one function for all layouts."""

from __future__ import annotations

import math
from collections.abc import Callable
from os import PathLike
from pathlib import Path

from kgs.errors import DataError

from .frames import BACKGROUNDS
from .images import image_folder, list_images
from .layouts.blender import load_blender
from .layouts.colmap import load_colmap
from .layouts.colmap_model import find_model
from .layouts.llff import load_llff
from .layouts.nerfstudio import load_nerfstudio
from .scene import Scene

__all__ = ["load_scene"]

_POINTS = ("none", "model-points")


def load_scene(
    path: str | PathLike[str],
    train_views: int | None = None,
    downscale: float | None = None,
    *,
    background: str = "black",
    points: str = "none",
) -> Scene:
    """Load a scene of posed photos, whatever layout it has.

    The layout is told by what the folder holds, in this order: `poses_bounds.npy` (LLFF), `sparse/0` or `sparse`
    (COLMAP), `transforms_train.json` (Blender), `transforms.json` (nerfstudio).

    Convention:
        Kornia's in the result, see `Views`: world-to-camera extrinsics with OpenCV axes, integer pixel centres. The
        world is the files', moved by `Scene.offset`, never scaled or turned.

    Args:
        path: the scene's folder.
        train_views: how many views to train on, spread evenly over those that are not held out; None takes all.
        downscale: how many times smaller the images shall be than those that are read (`images/`, else the largest
            `images_k/`), >= 1; None leaves them as they are.
        background: "black" or "white", put behind images with an alpha channel.
        points: "none", or "model-points" for the points of a COLMAP model that at least two training views observe.
            Their positions were refined with the test views too.

    Raises:
        DataError: the folder is no scene, or its files are missing, damaged or contradict each other.
        ValueError: train_views, downscale, background or points is out of range.

    Example:
        >>> scene = load_scene("fern", train_views=3, downscale=2)  # doctest: +SKIP
        >>> scene.train.images.shape  # doctest: +SKIP
        torch.Size([3, 3, 189, 252])
    """
    if background not in BACKGROUNDS:
        raise ValueError(f"background: expected one of {sorted(BACKGROUNDS)}, got {background!r}")
    if points not in _POINTS:
        raise ValueError(f"points: expected one of {list(_POINTS)}, got {points!r}")
    if downscale is not None and not (isinstance(downscale, (int, float)) and 1 <= downscale < math.inf):
        raise ValueError(f"downscale: expected None or a number of at least 1, got {downscale!r}")
    root = Path(path)
    if not root.is_dir():
        raise DataError(root, "", "expected a folder" + (", got a file" if root.exists() else ", there is none"))
    return _loader(root)(root, train_views, downscale, background, points)


def _loader(root: Path) -> Callable[[Path, int | None, float | None, str, str], Scene]:
    if (root / "poses_bounds.npy").is_file():
        return load_llff
    if find_model(root) is not None:
        return load_colmap
    if (root / "transforms_train.json").is_file():
        return load_blender
    if (root / "transforms.json").is_file():
        return load_nerfstudio
    photos = len(list_images(image_folder(root) or root))
    if photos:
        raise DataError(
            root,
            "",
            f"has {photos} photos but no camera poses: run COLMAP (its model goes to sparse/0) or nerfstudio's "
            "ns-process-data (transforms.json) on them first",
        )
    raise DataError(
        root,
        "",
        "is no scene: looked for poses_bounds.npy (LLFF), sparse/0 (COLMAP), transforms_train.json (Blender) and "
        "transforms.json (nerfstudio)",
    )
