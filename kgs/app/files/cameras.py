"""The list of cameras that 3DGS viewers read, and the rotation that makes a scene upright."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.geometry.cameras import posed, turned
from kgs.geometry.rigs import common_up

_OUTSIDE = 0.01  # share of the Gaussians that the bounds leave out at each side of each axis
_DISTANT = 10.0  # times the median distance from the middle: Gaussians beyond are a sky, outside the bounds


def camera_list(views: Sequence[Views], offset: Tensor, means: Tensor) -> list[dict[str, Any]]:
    """The content of the `cameras.json` that some viewers expect beside a 3DGS PLY file: one entry per view.

    Source: the reference implementation of B. Kerbl et al., "3D Gaussian Splatting", 2023. The format has no principal
    point, and no box: viewers that frame all Gaussians frame the few giants and strays around the scene. Readers take
    every element of the list for a camera and its values by their names, so a box is one more value of each.

    Convention:
        Camera to world in the coordinates of the PLY file, OpenCV axes: the `offset` of the Scene is added to the
        positions in float64. `rotation` holds the rows of the matrix.

    Returns:
        One dict per view: id (counted from 0), img_name, width, height, fx and fy (pixels), position (world units),
        rotation, and bounds (two opposite corners of a box, in world units; beyond each of its sides lies a hundredth
        of the centres of Gaussians, `means` `(N, 3)`, that are not in a sky; not without Gaussians).
    """
    box = {}
    if len(means):
        points = means.detach().double().cpu().numpy()
        distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
        near = points[distances <= _DISTANT * np.median(distances)]
        corners = np.quantile(near, [_OUTSIDE, 1 - _OUTSIDE], axis=0) + offset.double().cpu().numpy()
        box = {"bounds": corners.tolist()}
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
                    **box,
                }
            )
    return entries


def rolled(views: Views, degrees: float) -> Views:
    """The views with their pictures turned clockwise, such that photos which lie on their side stand upright.

    The pinhole cameras roll about their optical axes: they still show the same of the scene. Whole quarter turns turn
    the frame too; what is left of the angle, up to 45 degrees, tilts the scene within the frame.
    """
    if not degrees or not len(views):
        return views
    quarters = round(degrees / 90)
    angle = math.radians(degrees - 90 * quarters)
    roll = torch.eye(4, dtype=torch.float64)
    roll[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    poses = roll.to(views.cameras.extrinsics) @ views.cameras.extrinsics

    def rotated(image: Tensor) -> Tensor:
        return torch.rot90(image, -quarters, (-2, -1))

    return replace(
        views,
        cameras=turned(posed(views.cameras, poses), quarters),
        images=rotated(views.images),
        alphas=None if views.alphas is None else rotated(views.alphas),
        border_mask=None if views.border_mask is None else rotated(views.border_mask),
        valid_mask=None if views.valid_mask is None else rotated(views.valid_mask),
        depths=None if views.depths is None else rotated(views.depths),
    )


def shown(views: Views, degrees: float = 0.0) -> list[Views]:
    """The views as they are looked at, in their order, in parts of one size.

    Photos that were turned to have the size of the others are turned back; all are turned clockwise by `degrees`.
    """
    if views.turned is None:
        return [rolled(views, degrees)]
    return [
        replace(rolled(views.select([i]), degrees - 90 * is_turned), turned=None)
        for i, is_turned in enumerate(views.turned)
    ]


def shown_poses(views: Views, degrees: float = 0.0) -> Tensor:
    """The extrinsics of the views as they are looked at, `(V, 4, 4)`; see :func:`shown`."""
    return torch.cat([part.cameras.extrinsics for part in shown(views, degrees)])


def as_taken(image: Tensor, views: Views, index: int) -> Tensor:
    """A picture `(..., H, W)` of one view, turned back if its photo was turned."""
    return torch.rot90(image, 1, (-2, -1)) if views.turned and views.turned[index] else image


def upright(extrinsics: Tensor) -> Tensor:
    """The rotation from the cameras' world to an upright one, whose y axis is the common up direction of the cameras.

    Convention:
        The axes of glTF: y is up, and the mean viewing direction of the cameras, made horizontal, is -z. If the viewing
        directions cancel out, that of the first camera is used; if it is vertical, z is any horizontal direction.
        `extrinsics` are world-to-camera with OpenCV axes, `(V, 4, 4)`, V >= 1; the rotation is `(3, 3)` float64.
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
