"""The cameras of a scene for other programs, and the rotation that turns their world upright."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

import kgs
from kgs.datasets.scene import Views
from kgs.geometry import common_up


def camera_list(views: Sequence[Views], offset: Tensor) -> list[dict[str, Any]]:
    """What `cameras.json` beside a 3DGS PLY file holds, for viewers that look for it: an entry for each view.

    Source: the release of B. Kerbl et al., "3D Gaussian Splatting", 2023. The format has no principal point.

    Convention:
        Camera to world in the coordinates of the PLY file, OpenCV axes; `rotation` holds the rows of the matrix.

    Args:
        views: several sets of views, listed one after the other.
        offset: added to the positions in float64, `(3,)`: the `offset` of a Scene.

    Returns:
        id (from 0 on), img_name, width and height in pixels, position, rotation, fx and fy in pixels; and the version
        of kgs that wrote it.
    """
    entries = list[dict[str, Any]]()
    for part in views:
        poses = torch.linalg.inv(part.cameras.extrinsics.double().cpu())
        height, width = part.images.shape[-2:]
        for name, pose, lens in zip(part.names, poses, part.cameras.intrinsics.double().cpu(), strict=True):
            entry = {"id": len(entries), "img_name": name, "width": width, "height": height}
            entry |= {"position": (pose[:3, 3] + offset).tolist(), "rotation": pose[:3, :3].tolist()}
            entries.append(entry | {"fx": float(lens[0, 0]), "fy": float(lens[1, 1]), "kgs": kgs.__version__})
    return entries


def upright(extrinsics: Tensor) -> Tensor:
    """The rotation from the world of some cameras to one where their common up is y, `(3, 3)` float64.

    Convention:
        The world's axes become those of glTF: y is up, and the cameras look along -z on the whole.

    Args:
        extrinsics: world-to-camera, OpenCV axes, `(V, 4, 4)`, V >= 1.
    """
    up, ahead = common_up(extrinsics), extrinsics[:, 2, :3].double().cpu()
    back = -ahead.mean(0)
    back = back - (back @ up) * up
    if back.norm() < 0.1:  # they look inwards from all around
        back = -ahead[0] + (ahead[0] @ up) * up
        if back.norm() < 0.1:  # straight up or down
            back = torch.linalg.svd(up[None]).Vh[1]
    back = back / back.norm()
    return torch.stack([torch.linalg.cross(up, back), up, back])
