"""The photos' cameras as the viewer wants them: lenses, poses, what they look at, and where up is."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from kornia.geometry.camera import PinholeCamera
from numpy.typing import NDArray
from torch import Tensor

from kgs.geometry import camera_centers, common_up

Array = NDArray[np.float64]
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
    centres = camera_centers(cameras.extrinsics).numpy()
    points, found = means.detach().cpu().double().numpy(), list[dict[str, Any]]()
    for name, part, position, (k, pose, size) in zip(names, parts, centres, lenses(cameras), strict=True):
        depths = in_picture(points, k, pose, size)[:, 2]
        found.append(
            {"name": name, "part": part, "size": size.tolist(), "focal": k.diagonal()[:2].tolist()}
            | {"centre": k[:2, 2].tolist(), "rotation": pose[:3, :3].tolist(), "position": position.tolist()}
            | {"distance": float(np.median(depths)) if len(depths) else 1.0}
        )
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    nearest = np.sort(apart, axis=1)[:, 1] if len(found) > 1 else np.array([np.inf])
    deep = float(np.median([camera["distance"] for camera in found]))
    return {
        "cameras": found,
        "up": common_up(cameras.extrinsics).tolist(),
        "pyramid": min(_PYRAMID * float(np.median(nearest)) or deep, deep / 10),
    }


def lenses(cameras: PinholeCamera) -> list[tuple[Array, Array, NDArray[np.intp]]]:
    """Intrinsics, extrinsics (both `(4, 4)`), and width and height of each camera."""
    k, poses = (x.detach().cpu().double().numpy() for x in (cameras.intrinsics, cameras.extrinsics))
    sizes = np.array([cameras.width.tolist(), cameras.height.tolist()], np.intp).T
    return list(zip(k, poses, sizes, strict=True))


def in_picture(points: Array, k: Array, pose: Array, size: NDArray[np.intp], near_plane: float = 0.0) -> Array:
    """Those of the points `(N, 3)` that lie in the picture, beyond the near plane, in the camera's axes."""
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    seen = seen[seen[:, 2] > near_plane]
    pixels = seen[:, :2] / seen[:, 2:] * k.diagonal()[:2] + k[:2, 2]
    inside: Array = seen[((pixels >= -0.5) & (pixels <= size - 0.5)).all(axis=1)]
    return inside
