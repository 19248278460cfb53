"""From what a layout's files say about each photo to a Scene: the part that all layouts share."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

import kornia.geometry as kg
import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.errors import DataError

from .images import Intrinsics, read_image, resize, undistort
from .scene import Scene, Views
from .splits import split_by_name

__all__ = [
    "BACKGROUNDS",
    "NO_POINTS",
    "Frame",
    "PointCloud",
    "build_scene",
    "check_unique",
    "path_inside",
    "split_frames",
]

BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
_LISTED = 20
_LARGEST = 1e15  # a scene's numbers, and the inverse of a focal length: squares of them are finite in float32
_FINE_PIXELS = 1_000_000  # of the images for the first points: twice the pixels a side halves the error of the depths


@dataclass(frozen=True)
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
        DataError: a number is not finite or beyond 1e15, a size or focal length not positive, or the pose no rotation.
    """

    source: Path
    name: str
    path: Path
    intrinsics: Intrinsics
    pose: Tensor

    def __post_init__(self) -> None:
        lens, center = self.intrinsics, self.pose[:3, 3]
        numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
        if not np.isfinite(numbers).all():
            raise DataError(self.source, self.name, "expected finite intrinsics, got NaN or infinity")
        if not (min(lens.fx, lens.fy) * _LARGEST >= 1 and lens.width >= 1 and lens.height >= 1):
            raise DataError(
                self.source,
                self.name,
                "expected a focal length and an image size above 0, "
                f"got {lens.fx:g}, {lens.fy:g} and {lens.width}x{lens.height}",
            )
        if self.pose.shape != (4, 4) or not bool(torch.isfinite(self.pose).all()):
            raise DataError(self.source, self.name, "expected a finite 4x4 pose")
        if max(lens.width, lens.height, *map(abs, numbers), float(center.abs().max())) > _LARGEST:
            raise DataError(self.source, self.name, f"expected intrinsics and a camera centre up to {_LARGEST:g}")
        rotation = self.pose[:3, :3]
        error = float((rotation.mT @ rotation - torch.eye(3, dtype=torch.float64)).abs().max())
        if not (error <= 1e-3 and float(torch.linalg.det(rotation)) > 0):  # the products may be NaN
            raise DataError(self.source, self.name, "expected a pose with a right-handed rotation, got another matrix")


@dataclass(frozen=True)
class PointCloud:
    """Points that come with a layout.

    Args:
        points: `(P, 3)` float64, in the world of the poses.
        colors: `(P, 3)` in [0, 1].
        kind: what `Scene.init_kind` says of them.
    """

    points: Tensor
    colors: Tensor
    kind: str


NO_POINTS = PointCloud(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3), "none")


def path_inside(source: Path, root: Path, name: str, folder: Path | None = None) -> Path:
    """The path of a file that a description names, which must not lead out of the scene's folder.

    Args:
        source: the description; errors name it.
        root: the scene's folder.
        name: relative to `folder`.
        folder: inside `root`; None is `root` itself.

    Raises:
        DataError: the name is empty, absolute, has a part "..", or passes through a link that leads out of `root`.
    """
    given = PureWindowsPath(name)  # knows both separators and drives
    if not name or "\0" in name or given.drive or given.root or ".." in given.parts:
        raise DataError(source, repr(name[:200]), "expected the name of a file inside the scene's folder")
    path = (folder or root) / name
    try:
        path.is_file()
        target = Path(os.path.realpath(path))
    except (OSError, ValueError) as error:  # too long, or not to be written in the file system's encoding
        raise DataError(
            source, repr(name[:200]), f"expected the name of a file, got an impossible one ({error})"
        ) from error
    if not target.is_relative_to(os.path.realpath(root)):
        raise DataError(
            source, repr(name[:200]), "expected a file inside the scene's folder, got a link that leads out"
        )
    return path


def check_unique(frames: Sequence[Frame]) -> None:
    """Raise a DataError where two frames have one photo."""
    path, times = Counter(frame.path for frame in frames).most_common(1)[0]
    if times > 1:
        twice = next(frame for frame in frames if frame.path == path)
        raise DataError(twice.source, twice.name, f"expected each image once, got it {times} times")


def split_frames(root: Path, frames: Sequence[Frame], train_views: int | None) -> tuple[list[int], list[int]]:
    """Positions of the training and of the test frames: see `split_by_name`.

    Raises:
        DataError: there are fewer than two frames, or two of one photo.
        ValueError: train_views is out of range.
    """
    if len(frames) < 2:
        raise DataError(root, "", f"expected at least 2 posed images, one of them to test on, got {len(frames)}")
    check_unique(frames)
    return split_by_name([frame.name for frame in frames], train_views)


def build_scene(
    root: Path,
    train: Sequence[Frame],
    test: Sequence[Frame],
    downscale: float | None,
    background: str,
    cloud: PointCloud = NO_POINTS,
) -> Scene:
    """Read the photos of the frames and put cameras and points into one recentred world.

    The offset is the mean of the training cameras' centres, taken and subtracted in float64; nothing of the test
    frames enters it.

    Args:
        root: the scene's folder.
        train: the frames to train on, at least one.
        test: the frames that are held out, at least one.
        downscale: how many times smaller the images shall be, >= 1; None leaves them as they are.
        background: "black" or "white", put behind images with an alpha channel.
        cloud: the layout's own points.

    Raises:
        DataError: photos are missing, unreadable or of several sizes, a photo does not have the aspect of its
            intrinsics, or a point is out of range.
    """
    _check_present(root, [frame.path for frame in (*train, *test)])
    color = torch.tensor(BACKGROUNDS[background])
    offset = torch.stack([frame.pose[:3, 3] for frame in train]).mean(dim=0)
    if not bool((cloud.points.abs() <= _LARGEST).all()):
        raise DataError(root, "points", f"expected positions up to {_LARGEST:g}, got others")
    train_views = _views(train, offset, downscale, color)
    height, width = train_views.images.shape[-2:]
    fine_downscale = max(1.0, (downscale or 1.0) * math.sqrt(height * width / _FINE_PIXELS))
    is_finer = downscale is not None and fine_downscale < downscale
    return Scene(
        train=train_views,
        test=_views(test, offset, downscale, color, size=(height, width)),
        points=(cloud.points - offset).float(),
        point_colors=cloud.colors.float(),
        init_kind=cloud.kind,
        offset=offset,
        background=color,
        root=root,
        finer=_views(train, offset, fine_downscale, color) if is_finer else None,
    )


def _check_present(root: Path, paths: Sequence[Path]) -> None:
    """Raise one DataError that names every photo that is not there."""
    missing = [str(path.relative_to(root)) for path in paths if not path.is_file()]
    if missing:
        listed = ", ".join(missing[:_LISTED]) + (f" and {len(missing) - _LISTED} more" if missing[_LISTED:] else "")
        raise DataError(root, "", f"{len(missing)} of {len(paths)} images are missing: {listed}")


def _views(
    frames: Sequence[Frame],
    offset: Tensor,
    downscale: float | None,
    background: Tensor,
    size: tuple[int, int] | None = None,
) -> Views:
    """Read the frames' images; `size` is the (height, width) they shall have, by default the first one's."""
    count, alphas = len(frames), []
    intrinsics = torch.eye(4).repeat(count, 1, 1)
    for i, frame in enumerate(frames):
        pixels, alpha, lens = _load(frame, downscale, background)
        if i == 0:
            height, width = size or (lens.height, lens.width)
            images = torch.empty(count, 3, height, width)
        if (lens.height, lens.width) != (height, width):
            raise DataError(
                frame.path, "", f"expected {width}x{height} pixels as the other images, got {lens.width}x{lens.height}"
            )
        images[i] = pixels
        alphas.append(alpha)
        intrinsics[i, :3, :3] = torch.from_numpy(lens.matrix())
    opaque = torch.ones(1, height, width)
    has_alpha = any(alpha is not None for alpha in alphas)
    return Views(
        cameras=PinholeCamera(
            intrinsics,
            _extrinsics(frames, offset),
            torch.full((count,), float(height)),
            torch.full((count,), float(width)),
        ),
        images=images,
        names=tuple(frame.name for frame in frames),
        masks=torch.stack([opaque if alpha is None else alpha for alpha in alphas]) if has_alpha else None,
    )


def _load(frame: Frame, downscale: float | None, background: Tensor) -> tuple[Tensor, Tensor | None, Intrinsics]:
    """A frame's RGB on the background `(3, H, W)`, its alpha `(1, H, W)` if it has one, and its intrinsics."""
    image = read_image(frame.path)
    height, width = image.shape[:2]
    if not frame.intrinsics.same_aspect(width, height):
        raise DataError(
            frame.path,
            "",
            f"has {width}x{height} pixels, which is no scaled version of the "
            f"{frame.intrinsics.width}x{frame.intrinsics.height} that {frame.source.name} describes",
        )
    if image.shape[2] == 4:
        alpha = image[..., 3:]
        image[..., :3] = image[..., :3] * alpha + background.numpy() * (1 - alpha)
    try:
        image, lens = undistort(image, frame.intrinsics.scaled(width, height))
    except ValueError as error:
        raise DataError(frame.source, frame.name, str(error)) from error
    if downscale is not None:
        image, lens = resize(image, lens, max(1, round(width / downscale)), max(1, round(height / downscale)))
    pixels = torch.from_numpy(image).permute(2, 0, 1)
    return pixels[:3], pixels[3:] if len(pixels) == 4 else None, lens


def _extrinsics(frames: Sequence[Frame], offset: Tensor) -> Tensor:
    """World-to-camera `(V, 4, 4)` float32 in the recentred world, the rotations made exactly orthogonal."""
    poses = torch.stack([frame.pose for frame in frames])
    u, _, vh = torch.linalg.svd(poses[:, :3, :3])
    rotation, translation = kg.camtoworld_to_worldtocam_Rt(u @ vh, poses[:, :3, 3:] - offset[:, None])
    return kg.Rt_to_matrix4x4(rotation, translation).float()
