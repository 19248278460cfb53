"""The photos' cameras for the viewer: lenses, poses, what they see, which way is up, and how far they reach around."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from numpy.typing import NDArray
from torch import Tensor

from kgs.app.files.encoders import RATE
from kgs.app.files.film import FRAMES, resample_by_speed
from kgs.geometry.cameras import select, to, turned
from kgs.geometry.multiview import points_in_images, typical_depths
from kgs.geometry.rigs import camera_centers, common_up

Array = NDArray[np.float64]
_PYRAMID = 0.3  # depth of a pyramid, as a share of the median distance between neighbouring cameras
_LARGEST_PYRAMID = 0.1  # its upper bound, as a share of the median depth of the scene
_MIN_ARC = 0.3  # radians
_RING_GAP = 2 * math.pi / 3  # cameras with smaller gaps between them surround the scene
_DIGITS = 6  # of a position, after the point, in depths of the scene


def viewer_scene(
    cameras: PinholeCamera,  # their skew is ignored
    names: Sequence[str],  # the file names of their photos
    parts: Sequence[str],  # what each photo was used for: "training", "test", or another word
    means: Tensor,  # centres of the Gaussians; the viewer orbits a point at their median depth
    psnr: Mapping[str, float] | None = None,  # of the renders of photos, in dB, by their names, if it is known
    path: PinholeCamera | None = None,  # the cameras of the film; None: those of the training photos
) -> dict[str, Any]:
    """The cameras, the one to open at, the upright direction and the size of the pyramids, as plain numbers for JSON.

    Convention:
        OpenCV axes, integer pixel centres. A rotation's rows are right, down and forward in the world.

    Returns:
        cameras: for each camera its name, part, label (its photo's number in the order of names), size (width, height),
            focal lengths and principal point (pixels), rotation, position, and the median depth of the Gaussians that
            it sees (distance).
        first: index of the camera that the viewer opens at: among the third of the training cameras that are nearest
            the mean pose the one of the highest PSNR, or the nearest where none is known.
        up: the upright direction in the world, of length 1.
        pyramid: depth of the pyramids that stand for the cameras, in world units.
        arc: how far around the scene the cameras of the film reach, see `_arc`.
        turned: `up` and `arc` where the pictures are turned clockwise by one, two and three quarters.
        tour: the rotations and positions of the cameras of the film, see :func:`kgs.app.files.film.resample_by_speed`
            (poses), and its length (seconds).
    """
    path = training_cameras(cameras, parts) if path is None else to(path, "cpu")
    cameras = to(cameras, "cpu", torch.float64)
    positions = camera_centers(cameras.extrinsics).numpy()
    entries = list[dict[str, Any]]()
    order = {name: number for number, name in enumerate(sorted(names), 1)}
    for i, (name, part, position) in enumerate(zip(names, parts, positions, strict=True)):
        camera = select(cameras, i)
        depths, inside = points_in_images(means.detach(), camera)
        seen = depths[inside]
        k = camera.intrinsics[0]
        entries.append(
            {
                "name": name,
                "part": part,
                "label": f"photo {order[name]} of {len(order)}{', held out' if part == 'test' else ''}",
                "size": [int(camera.width), int(camera.height)],
                "focal": k.diagonal()[:2].tolist(),
                "centre": k[:2, 2].tolist(),
                "rotation": camera.extrinsics[0, :3, :3].tolist(),
                "position": position.tolist(),
                "distance": float(np.median(seen)) if len(seen) else 1.0,
            }
        )
    depth = float(np.median([camera["distance"] for camera in entries]))
    rotations = np.array([camera["rotation"] for camera in entries])
    training = are_training(parts)
    middle = _nearest_mean_pose(rotations, positions / depth, training)
    first = max(middle[: math.ceil(len(middle) / 3)], key=lambda i: (psnr or {}).get(names[i], -math.inf))
    distance = entries[first]["distance"]
    return {
        "cameras": entries,
        "first": first,
        "pyramid": _pyramid_depth(positions, depth),
        **_up_and_arc(cameras, path, first, distance),
        "turned": [
            _up_and_arc(turned(cameras, quarters), turned(path, quarters), first, distance) for quarters in (1, 2, 3)
        ],
        "tour": _tour(path, means),
    }


def are_training(parts: Sequence[str]) -> list[bool]:
    """Which photos count as training photos, by what they were used for: all but "test", or all if all are "test"."""
    training = [part != "test" for part in parts]
    return training if any(training) else [True] * len(parts)


def training_cameras(cameras: PinholeCamera, parts: Sequence[str]) -> PinholeCamera:
    """Those of the training photos, on the CPU; see :func:`are_training`."""
    return to(select(cameras, np.flatnonzero(are_training(parts)).tolist()), "cpu")


def _nearest_mean_pose(rotations: Array, positions: Array, training: Sequence[bool]) -> list[int]:
    """Indices of the training cameras, those first whose poses are nearest the mean of the training poses.

    Positions are in depths of the scene: to move by 0.1 of the depth counts about as much as to turn by 0.1.
    """
    chosen = np.flatnonzero(training)
    # Rotation matrices that differ by a small angle have a distance of sqrt(2) times it.
    poses = np.concatenate([rotations.reshape(-1, 9), 2**0.5 * positions], axis=1)[chosen]
    distances = np.linalg.norm(poses - poses.mean(axis=0), axis=1)
    return [int(i) for i in chosen[distances.argsort(kind="stable")]]


def _arc(rotations: Array, positions: Array, distance: float, up: Array) -> dict[str, Any]:
    """The angles from which the cameras see the scene, in radians.

    An eye looks from the opposite of its forward direction. So does a camera; it also shows what an eye would see that
    stood in its place and looked at the point in front of the first camera, at `distance`.

    Returns:
        origin: the horizontal direction of yaw 0, from which the first camera looks, `(3,)`.
        yaw: smallest and largest angle about `up`, counterclockwise; None where the cameras surround the scene.
        pitch: smallest and largest angle above the horizon.
    """
    focus = positions[0] + distance * rotations[0, 2]
    beside = positions - focus
    beside = beside[np.linalg.norm(beside, axis=1) > 1e-6 * distance]
    origin = -rotations[0, 2]
    origin = origin - (origin @ up) * up
    if np.linalg.norm(origin) < 1e-6:  # it looks straight down: the top of its picture is where it looks to
        origin = rotations[0, 1] - (rotations[0, 1] @ up) * up
    origin /= np.linalg.norm(origin)
    directions = np.concatenate([-rotations[:, 2], beside / np.linalg.norm(beside, axis=1, keepdims=True)])
    pitches = np.arcsin((directions @ up).clip(-1, 1))
    yaws = np.sort(np.arctan2(np.cross(origin, directions) @ up, directions @ origin))
    gaps = np.diff(yaws, append=yaws[0] + 2 * math.pi)
    widest = int(gaps.argmax())  # the arc is all but this gap
    low, high = yaws[(widest + 1) % len(yaws)], yaws[widest]
    if low > high:
        low, high = (low - 2 * math.pi, high) if low > 0 else (low, high + 2 * math.pi)
    return {
        "origin": origin.tolist(),
        "yaw": None if gaps[widest] < _RING_GAP else _widened(float(low), float(high)),
        "pitch": _widened(float(pitches.min()), float(pitches.max())),
    }


def _up_and_arc(cameras: PinholeCamera, path: PinholeCamera, first: int, distance: float) -> dict[str, Any]:
    """What is up for these cameras, and the arc of the first one and those of the film."""
    up = common_up(cameras.extrinsics)
    poses = torch.cat([cameras.extrinsics[[first]], path.extrinsics.double()])
    arc = _arc(poses[:, :3, :3].numpy(), camera_centers(poses).numpy(), distance, up.numpy())
    return {"up": up.tolist(), "arc": arc}


def _widened(low: float, high: float) -> list[float]:
    """Both ends of an arc, at least `_MIN_ARC` apart."""
    more = max(0.0, _MIN_ARC - (high - low)) / 2
    return [low - more, high + more]


def _tour(cameras: PinholeCamera, means: Tensor) -> dict[str, Any]:
    """The path of the film through some cameras: `FRAMES` rotations and positions at equal times, and seconds."""
    depth = typical_depths(means, cameras)[1]
    poses = resample_by_speed(cameras.extrinsics, FRAMES, depth)
    rotations = poses[:, :3, :3].numpy()
    positions = camera_centers(poses).numpy()
    digits = _DIGITS - math.floor(math.log10(depth))
    rows = zip(rotations.round(_DIGITS).tolist(), positions.round(digits).tolist(), strict=True)
    return {
        "seconds": FRAMES / RATE,
        "poses": [{"rotation": rotation, "position": position} for rotation, position in rows],
    }


def _pyramid_depth(positions: Array, depth: float) -> float:
    """Depth of the pyramids in world units, so small that those of neighbouring cameras do not overlap."""
    largest = _LARGEST_PYRAMID * depth
    if len(positions) == 1:
        return largest
    distances = np.linalg.norm(positions[:, None] - positions, axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = float(np.median(distances.min(axis=1)))
    return min(_PYRAMID * nearest, largest) if nearest > 0 else largest
