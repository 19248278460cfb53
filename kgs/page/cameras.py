"""The photos' cameras as the viewer wants them: lenses, poses, what they look at, and where up is."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.camera import common_up

_PYRAMID = 0.3  # height of a pyramid, in typical distances between neighbours; at most a tenth of the view's depth


def viewer_scene(cameras: PinholeCamera, names: Sequence[str], parts: Sequence[str], means: Tensor) -> dict[str, Any]:
    """Cameras, upright direction and size of the pyramids, as plain numbers.

    Convention:
        OpenCV axes, integer pixel centres. A rotation's rows are right, down and forward in the world.

    Args:
        cameras: the C cameras; a skew is left aside.
        names: of their photos.
        parts: what each photo was used for, a word.
        means: centres of the Gaussians, `(N, 3)`; the eye turns about their median depth.
    """
    sizes = np.array([cameras.width.tolist(), cameras.height.tolist()], int).T
    k, poses = (x.detach().cpu().double().numpy() for x in (cameras.intrinsics, cameras.extrinsics))
    points, found = means.detach().cpu().double().numpy(), list[dict[str, Any]]()
    for name, part, size, lens, pose in zip(names, parts, sizes, k, poses, strict=True):
        rotation, position = pose[:3, :3], -np.linalg.inv(pose[:3, :3]) @ pose[:3, 3]
        seen = points @ rotation.T + pose[:3, 3]
        seen = seen[seen[:, 2] > 0]
        pixels = seen[:, :2] / seen[:, 2:] * lens[[0, 1], [0, 1]] + lens[:2, 2]
        inside = seen[((pixels >= -0.5) & (pixels <= size - 0.5)).all(axis=1), 2]
        found.append(
            {"name": name, "part": part, "size": size.tolist(), "focal": lens[[0, 1], [0, 1]].tolist()}
            | {"centre": lens[:2, 2].tolist(), "rotation": rotation.tolist(), "position": position.tolist()}
            | {"distance": float(np.median(inside)) if len(inside) else 1.0}
        )
    centres = np.array([camera["position"] for camera in found])
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    nearest = np.sort(apart, axis=1)[:, 1] if len(found) > 1 else np.array([np.inf])
    deep = float(np.median([camera["distance"] for camera in found]))
    return {
        "cameras": found,
        "up": common_up(cameras.extrinsics).tolist(),
        "pyramid": min(_PYRAMID * float(np.median(nearest)) or deep, deep / 10),
    }
