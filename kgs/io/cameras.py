"""The list of cameras that 3DGS viewers read, and the rotation that makes a scene upright."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

import kgs
from kgs.datasets.scene import Views
from kgs.geometry import common_up

from .ownership import MADE_BY


def camera_list(views: Sequence[Views], offset: Tensor) -> list[dict[str, Any]]:
    """The content of the `cameras.json` that some viewers expect beside a 3DGS PLY file: one entry per view.

    Source: the reference implementation of B. Kerbl et al., "3D Gaussian Splatting", 2023. The format has no principal
    point.

    Convention:
        Camera to world in the coordinates of the PLY file, OpenCV axes. `rotation` holds the rows of the matrix.

    Args:
        views: sets of views, listed one after the other.
        offset: the `offset` of the Scene, `(3,)`, in world units. It is added to the positions in float64.

    Returns:
        One dict per view: id (counted from 0), img_name, width, height, fx and fy (pixels), position (world units),
        rotation, and generator, the version of kgs that wrote it.
    """
    entries = list[dict[str, Any]]()
    for part in views:
        height, width = part.images.shape[-2:]
        poses = torch.linalg.inv(part.cameras.extrinsics.double().cpu())
        intrinsics = part.cameras.intrinsics.double().cpu()
        for name, pose, k in zip(part.names, poses, intrinsics, strict=True):
            entries.append(
                {
                    "id": len(entries),
                    "img_name": name,
                    "width": width,
                    "height": height,
                    "position": (pose[:3, 3] + offset).tolist(),
                    "rotation": pose[:3, :3].tolist(),
                    "fx": float(k[0, 0]),
                    "fy": float(k[1, 1]),
                    "generator": f"{MADE_BY} {kgs.__version__}",
                }
            )
    return entries


def upright(extrinsics: Tensor) -> Tensor:
    """The rotation from the cameras' world to an upright one, whose y axis is the common up direction of the cameras.

    Convention:
        The axes of glTF: y is up, and the mean viewing direction of the cameras, made horizontal, is -z. If the viewing
        directions cancel out, that of the first camera is used; if it is vertical, z is any horizontal direction.

    Args:
        extrinsics: world-to-camera, OpenCV axes, `(V, 4, 4)`, V >= 1.

    Returns:
        A rotation, `(3, 3)` float64.
    """
    up = common_up(extrinsics)
    forward = extrinsics[:, 2, :3].double().cpu()
    back = _horizontal(-forward.mean(0), up)
    if back.norm() < 0.1:  # the cameras look inwards from all sides
        back = _horizontal(-forward[0], up)
    if back.norm() < 0.1:  # the first camera looks straight up or down
        back = torch.linalg.svd(up[None]).Vh[1]
    back = back / back.norm()
    return torch.stack([torch.linalg.cross(up, back), up, back])


def _horizontal(direction: Tensor, up: Tensor) -> Tensor:
    """The part of a direction `(3,)` that is perpendicular to the unit vector `up`."""
    return direction - (direction @ up) * up
