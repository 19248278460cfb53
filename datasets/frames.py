"""What every layout's files say about a scene: photos with lenses and poses, and how they are split."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PureWindowsPath

import numpy as np
import torch
from torch import Tensor

from kgs.errors import DataError

from .images import Intrinsics

LARGEST = 1e15  # a scene's numbers, and the inverse of a focal length: squares of them are finite in float32


@dataclass(frozen=True, eq=False)
class Frame:
    """One photo with its lens and its pose, its pixels not read yet.

    Convention:
        `pose` is camera-to-world with OpenCV axes (x right, y down, z forward).

    Args:
        source: the file that gives lens and pose; errors name it.
        name: what the view is called, unique within its scene.
        path: the photo.
        intrinsics: in the files' half-pixel convention, for any size of the photo's aspect.
        pose: `(4, 4)` float64.

    Raises:
        DataError: a number is not finite or beyond 1e15, a size or focal length is not above 0, or the pose is no
            rotation and translation.
    """

    source: Path
    name: str
    path: Path
    intrinsics: Intrinsics
    pose: Tensor

    def __post_init__(self) -> None:
        wrong = partial(DataError, self.source, self.name)
        lens, center, rotation = self.intrinsics, self.pose[:3, 3], self.pose[:3, :3]
        numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
        if not np.isfinite(numbers).all():
            raise wrong("expected finite intrinsics, got NaN or infinity")
        if not (min(lens.fx, lens.fy) * LARGEST >= 1 and lens.width >= 1 and lens.height >= 1):
            got = f"{lens.fx:g}, {lens.fy:g} and {lens.width}x{lens.height}"
            raise wrong(f"expected a focal length and an image size above 0, got {got}")
        if self.pose.shape != (4, 4) or not bool(torch.isfinite(self.pose).all()):
            raise wrong("expected a finite 4x4 pose")
        if max(lens.width, lens.height, *map(abs, numbers), float(center.abs().max())) > LARGEST:
            raise wrong(f"expected intrinsics and a camera centre up to {LARGEST:g}")
        error = float((rotation.mT @ rotation - torch.eye(3, dtype=torch.float64)).abs().max())
        if not (error <= 1e-3 and float(torch.linalg.det(rotation)) > 0):  # the products may be NaN
            raise wrong("expected a pose with a right-handed rotation, got another matrix")


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points `(P, 3)` float64 in the world of the poses, colours `(P, 3)` in [0, 1], and `Scene.init_kind` of both."""

    points: Tensor
    colors: Tensor
    kind: str


NO_POINTS = PointCloud(torch.zeros(0, 3, dtype=torch.float64, device="cpu"), torch.zeros(0, 3, device="cpu"), "none")


@dataclass(frozen=True, eq=False)
class FrameSet:
    """All that a layout's files say.

    Args:
        frames: all frames, or, where the files hold some out, those to choose training views from.
        test: the frames that the files hold out; None where they do not say: every eighth by name is held out then.
        published: positions in `frames` of the published training views, taken when just as many are asked for.
        points: first points that the layout always gives.
        model_points: the points of the scene's COLMAP model that at least two of the given frames see; None where
            there is no model.
        notes: what the files say that is not used, one sentence each.
    """

    frames: Sequence[Frame]
    test: Sequence[Frame] | None = None
    published: Sequence[int] = ()
    points: PointCloud = NO_POINTS
    model_points: Callable[[Sequence[Frame]], PointCloud] | None = None
    notes: tuple[str, ...] = ()


def path_inside(source: Path, root: Path, name: str, folder: Path | None = None) -> Path:
    """The path of a file that a description names, which must not lead out of the scene's folder.

    Args:
        source: the description; errors name it.
        root: the scene's folder.
        name: relative to `folder`; backslashes separate folders where no file has them in its name.
        folder: inside `root`; None is `root` itself.

    Raises:
        DataError: the name is empty, absolute, has a part "..", or passes through a link that leads out of `root`.
    """
    wrong = partial(DataError, source, repr(name[:200]))
    given = PureWindowsPath(name)  # knows both separators and drives
    if not name or "\0" in name or given.drive or given.root or ".." in given.parts:
        raise wrong("expected the name of a file inside the scene's folder")
    path = (folder or root) / name
    try:
        if not path.is_file():
            path = (folder or root) / given.as_posix()
        path.is_file()
        target = Path(os.path.realpath(path))
    except (OSError, ValueError) as error:  # too long, or not to be written in the file system's encoding
        raise wrong(f"expected the name of a file, got an impossible one ({error})") from error
    if not target.is_relative_to(os.path.realpath(root)):
        raise wrong("expected a file inside the scene's folder, got a link that leads out")
    return path
