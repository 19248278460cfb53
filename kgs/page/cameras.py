"""The photos' cameras for the viewer: intrinsics, poses, the depth of what they see, and which way is up."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from kornia.geometry.camera import PinholeCamera
from numpy.typing import NDArray
from torch import Tensor

from kgs.geometry import camera_centers, common_up

Array = NDArray[np.float64]
_PYRAMID = 0.3  # depth of a pyramid, as a share of the median distance between neighbouring cameras
_LARGEST_PYRAMID = 0.1  # its upper bound, as a share of the median depth of the scene


def viewer_scene(cameras: PinholeCamera, names: Sequence[str], parts: Sequence[str], means: Tensor) -> dict[str, Any]:
    """The cameras, the one to open at, the upright direction and the size of the pyramids, as plain numbers for JSON.

    Convention:
        OpenCV axes, integer pixel centres. A rotation's rows are right, down and forward in the world.

    Args:
        cameras: the C cameras; their skew is ignored.
        names: the file names of their C photos.
        parts: what each photo was used for: "training", "test", or another word.
        means: centres of the Gaussians, `(N, 3)`, in world units. The viewer orbits a point at their median depth.

    Returns:
        cameras: for each camera its name, part, size (width, height), focal lengths and principal point (pixels),
            rotation, position, and the median depth of the Gaussians that it sees (distance).
        first: index of the camera that the viewer opens at, the training camera nearest the mean pose.
        up: the upright direction in the world, of length 1.
        pyramid: depth of the pyramids that stand for the cameras, in world units.
    """
    positions = camera_centers(cameras.extrinsics).numpy()
    points = means.detach().cpu().double().numpy()
    found = list[dict[str, Any]]()
    for name, part, position, (k, pose, size) in zip(names, parts, positions, lenses(cameras), strict=True):
        depths = visible_points(points, k, pose, size)[:, 2]
        found.append(
            {
                "name": name,
                "part": part,
                "size": size.tolist(),
                "focal": k.diagonal()[:2].tolist(),
                "centre": k[:2, 2].tolist(),
                "rotation": pose[:3, :3].tolist(),
                "position": position.tolist(),
                "distance": float(np.median(depths)) if len(depths) else 1.0,
            }
        )
    depth = float(np.median([camera["distance"] for camera in found]))
    rotations = np.array([camera["rotation"] for camera in found])
    return {
        "cameras": found,
        "first": _nearest_mean_pose(rotations, positions / depth, [part != "test" for part in parts]),
        "up": common_up(cameras.extrinsics).tolist(),
        "pyramid": _pyramid_depth(positions, depth),
    }


def lenses(cameras: PinholeCamera) -> list[tuple[Array, Array, NDArray[np.intp]]]:
    """Intrinsics, extrinsics (both `(4, 4)`), and width and height of each camera."""
    k, poses = (x.detach().cpu().double().numpy() for x in (cameras.intrinsics, cameras.extrinsics))
    sizes = np.array([cameras.width.tolist(), cameras.height.tolist()], np.intp).T
    return list(zip(k, poses, sizes, strict=True))


def visible_points(points: Array, k: Array, pose: Array, size: NDArray[np.intp], near_plane: float = 0.0) -> Array:
    """Those of the points `(N, 3)` that lie inside the image and beyond the near plane, in the camera's axes."""
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    seen = seen[seen[:, 2] > near_plane]
    pixels = seen[:, :2] / seen[:, 2:] * k.diagonal()[:2] + k[:2, 2]
    inside: Array = seen[((pixels >= -0.5) & (pixels <= size - 0.5)).all(axis=1)]
    return inside


def _nearest_mean_pose(rotations: Array, positions: Array, training: Sequence[bool]) -> int:
    """Index of the training camera whose pose is nearest the mean of the training poses; of all, without training ones.

    Args:
        rotations: world to camera, `(C, 3, 3)`.
        positions: `(C, 3)`, in depths of the scene: to move by 0.1 of the depth counts about as much as to turn by 0.1.
        training: which cameras took training photos, C values.
    """
    chosen = np.flatnonzero(training) if any(training) else np.arange(len(positions))
    # Rotation matrices that differ by a small angle have a distance of sqrt(2) times it.
    poses = np.concatenate([rotations.reshape(-1, 9), 2**0.5 * positions], axis=1)[chosen]
    return int(chosen[np.linalg.norm(poses - poses.mean(axis=0), axis=1).argmin()])


def _pyramid_depth(positions: Array, depth: float) -> float:
    """Depth of the pyramids in world units, so small that those of neighbouring cameras do not overlap."""
    largest = _LARGEST_PYRAMID * depth
    if len(positions) == 1:
        return largest
    distances = np.linalg.norm(positions[:, None] - positions, axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = float(np.median(distances.min(axis=1)))
    return min(_PYRAMID * nearest, largest) if nearest > 0 else largest
