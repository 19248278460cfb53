"""What the files of a layout say about a scene: photos with lenses and poses, and how they are split."""

import math
import os
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path, PureWindowsPath

import numpy as np
import torch
from torch import Tensor

from kgs._support.errors import DataError

from .image_file import ImageFile
from .images import Intrinsics
from .masks import Mask

LARGEST = 1e15  # a scene's numbers: squares of them are finite in float32
SMALLEST = 1e-8  # of the way between cameras: below it depths are lost beside the constants of a render
SHORTEST_FOCAL = 0.1  # of the side: shorter ones are no pixels, but shares of the side
_ROUNDED = 2e-3  # of the products of axes: what rounding to three digits leaves; `load_scene` makes them orthonormal


@dataclass(frozen=True, eq=False)
class Frame:
    """One photo with its lens and pose, its pixels not read yet; numbers that no camera has are a DataError."""

    source: Path  # the file that gives lens and pose; errors name it
    name: str  # unique within the scene
    image: ImageFile
    intrinsics: Intrinsics  # for any size of the photo's aspect
    pose: Tensor  # (4, 4) float64, camera-to-world with OpenCV axes (x right, y down, z forward)
    mask: Mask | None = None  # which of its pixels are kept; None: all
    depths: Path | None = None  # the file of its depth map

    @property
    def path(self) -> Path:
        """The photo's file."""
        return self.image.path

    def __post_init__(self) -> None:
        wrong = partial(DataError, self.source, self.name)
        lens = self.intrinsics
        center = self.pose[:3, 3]
        numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
        if not np.isfinite(numbers).all():
            raise wrong("finite intrinsics", "NaN or infinity")
        if not min(lens.width, lens.height) >= 1:
            raise wrong("an image size above 0", f"{lens.width}x{lens.height}")
        if not (lens.fx >= SHORTEST_FOCAL * lens.width and lens.fy >= SHORTEST_FOCAL * lens.height):
            got = f"{lens.fx:g} and {lens.fy:g} for {lens.width}x{lens.height}"
            raise wrong("focal lengths in pixels, at least a tenth of the sides", got)
        if not (0 < lens.cx < lens.width and 0 < lens.cy < lens.height):
            raise wrong("a principal point in the image", f"{lens.cx:g}, {lens.cy:g} in {lens.width}x{lens.height}")
        if self.pose.shape != (4, 4) or not bool(torch.isfinite(self.pose).all()):
            raise wrong("a finite 4x4 pose")
        if max(lens.width, lens.height, *map(abs, numbers), float(center.abs().max())) > LARGEST:
            raise wrong(f"intrinsics and a camera centre up to {LARGEST:g}")


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points `(P, 3)` float64 in the world of the poses, colours `(P, 3)` in [0, 1], and `Scene.init_kind` of both."""

    points: Tensor
    colors: Tensor
    kind: str


NO_POINTS = PointCloud(torch.zeros(0, 3, dtype=torch.float64, device="cpu"), torch.zeros(0, 3, device="cpu"), "none")


@dataclass(frozen=True, eq=False)
class FrameSet:
    """Everything that a layout's files say about a scene."""

    frames: Sequence[Frame]  # those to choose training views from; all of them if `test` is None
    test: Sequence[Frame] | None = None  # those that the files hold out; None: every eighth by name is held out
    published: Sequence[int] = ()  # positions of the published training views, taken if as many are asked for
    points: PointCloud = NO_POINTS  # initial points that the layout always gives
    # the points of the scene's COLMAP model, if there is one, that at least two of the given frames see
    model_points: Callable[[Sequence[Frame]], PointCloud] | None = None
    notes: tuple[str, ...] = ()  # what the files say that is not used, one sentence each


def check_rotation(source: Path, name: str, pose: Tensor) -> None:
    """Raise a DataError unless a file's pose `(3+, 3+)`, in the axes of the file, has a right-handed rotation."""
    axes = pose[:3, :3]
    products = axes.mT @ axes
    square = float(products.diagonal().mean())  # of the length of an axis
    error = float((products / square - torch.eye(3, dtype=axes.dtype)).abs().max())
    if not (error <= _ROUNDED and float(torch.linalg.det(axes)) > 0):  # the products may be NaN
        raise DataError(source, name, "a right-handed rotation", str(axes.tolist()))
    if abs(square - 1) > _ROUNDED:
        raise DataError(
            source, name, "a rotation", f"one scaled by {math.sqrt(square):.4g}", advice="divide it by that"
        )


def path_inside(source: Path, root: Path, name: str, folder: Path | None = None) -> Path:
    """The path of a file that `source` names, relative to `folder` or `root`; a DataError if it leads out."""
    wrong = partial(DataError, source, repr(name[:200]))
    given = PureWindowsPath(name)  # knows both separators and drives; a file may have backslashes in its name, too
    if not name or "\0" in name or given.drive or given.root or ".." in given.parts:
        raise wrong("the name of a file inside the scene's folder")
    folder = folder or root
    try:
        path = folder / name if (folder / name).is_file() else folder / given.as_posix()
        target = Path(os.path.realpath(path))
    except (OSError, ValueError) as error:  # too long, or not to be written in the file system's encoding
        raise wrong("the name of a file", "an impossible one", advice=str(error)) from error
    if not target.is_relative_to(os.path.realpath(root)):
        raise wrong("a file inside the scene's folder", "a link that leads out")
    return path


def find_file(source: Path, root: Path, name: str, folder: Path | None = None) -> Path:
    """As `path_inside`, but a name that no file has stands for the one file that differs in case or in Unicode's form.

    Cameras and other systems write `IMG_1.PNG` for `IMG_1.png`, or an é as e and an accent.
    """
    path = path_inside(source, root, name, folder)
    if path.is_file():
        return path
    at = folder or root
    for part in path.relative_to(at).parts:
        if not (at / part).exists():
            alike = _names_in(at, at.stat().st_mtime_ns)[_plain(part)] if at.is_dir() else []
            if len(alike) != 1:
                return path
            part = alike[0]
        at = at / part
    return path_inside(source, root, str(at.relative_to(folder or root)), folder)


@lru_cache(maxsize=8)
def _names_in(folder: Path, modified_ns: int) -> defaultdict[str, list[str]]:
    """The names in a folder by their plain form; `modified_ns` makes a folder that changed another one."""
    names = defaultdict[str, list[str]](list)
    for path in folder.iterdir():
        names[_plain(path.name)].append(path.name)
    return names


def _plain(name: str) -> str:
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())
