"""A film of a splat: a smooth path through the training cameras at one speed, as a file that browsers play."""

import os
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from kgs._support.progress import ProgressBar, silent
from kgs.datasets.scene import Views
from kgs.geometry.cameras import image_size, pinhole_cameras, posed, resized
from kgs.geometry.multiview import typical_depths
from kgs.geometry.rigs import camera_centers, meeting_point

from .cameras import upright
from .encoders import encode
from .images import eight_bits

FRAMES = 144
_RAMP = 0.07  # share of the path on which a film gets up to its speed, and again of that on which it slows down
_TURN = 40.0  # largest v^2 / r at speed 1, in path lengths: only turns of a radius below 1/40 of the path are slow
_PIECES = 4000  # in which a path is measured
LONGEST = 1920  # pixels of the longer side: what all players and messengers take
_STOPS = 12  # largest number of cameras on a path: as many as three seconds can pass smoothly
_SWAY = 0.03  # radius of the path around a single camera, as a share of the scene's depth
_CLEAR = 0.5  # of the nearest typical depth
Array = NDArray[np.float64]


def write_film(
    path: str | os.PathLike[str],
    render: Callable[[PinholeCamera], Tensor],
    views: Views,
    depth: float,  # from the cameras to the scene, in world units
    bar: ProgressBar = silent,
) -> str:
    """Write a film along the :func:`camera_path` through some views, as MP4 or WebM by the suffix. The write is atomic.

    The film has `FRAMES` frames at `RATE` frames per second; see :func:`resample_by_speed` for its speed. Frames have
    the size of the views, reduced to at most `LONGEST` pixels and rounded to even numbers, and the mean of their
    intrinsics. `render` makes an image `(1, 3, H, W)` of a camera.

    Returns:
        "", or the reason why no film was written: there is no encoder for it here.
    """
    path = Path(path)
    height, width = views.images.shape[-2:]
    shrink = min(1.0, LONGEST / max(height, width))
    size = (max(2, 2 * round(height * shrink / 2)), max(2, 2 * round(width * shrink / 2)))
    camera = pinhole_cameras(views.cameras.extrinsics[:1], views.cameras.intrinsics.mean(0), width, height)
    camera = resized(camera, (size[1] / width, size[0] / height), size)
    poses = resample_by_speed(views.cameras.extrinsics, FRAMES, depth).to(camera.extrinsics)
    part = path.with_name(f".{path.name}")  # OpenCV chooses the format by the suffix
    frames = (posed(camera, pose[None]) for pose in bar(list(poses), "film", "frame"))
    try:
        if why := encode(part, (eight_bits(render(frame)[0]) for frame in frames), image_size(camera)[::-1]):
            return f"no {path.name}: {why}"
        os.replace(part, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        part.unlink(missing_ok=True)
    return ""


def path_near_plane(means: Tensor, cameras: PinholeCamera, near_plane: float) -> float:
    """The near plane of a camera beside those of the photos, in world units: half of the nearest typical depth.

    A path between the photos' cameras can lead through Gaussians, `means` `(N, 3)`, that no photo has before it there.
    They would fill the picture. It is not below the near plane of the fit.
    """
    return max(near_plane, _CLEAR * typical_depths(means, cameras)[0])


def resample_by_speed(extrinsics: Tensor, frames: int, depth: float) -> Tensor:
    """Poses of a :func:`camera_path` at the times of the frames of a film, in which the camera moves at one speed.

    The speed is that of the position, in largest distances between cameras, and of the viewing direction, in half
    turns, as the hypotenuse of both. The film begins and ends at rest, with the same acceleration over the first and
    last `_RAMP` of the path. Where the path turns back, as at the end of a row of cameras, the camera slows down.

    The first pose is that of a camera; after the last one the path would be there again.

    Convention:
        World-to-camera extrinsics with OpenCV axes, `(V, 4, 4)` in, V >= 1, and `(frames, 4, 4)` float64 out.
    """
    even = np.linspace(0, 1, _PIECES + 1)
    path = torch.linalg.inv(camera_path(extrinsics, even, depth))
    centers = camera_centers(extrinsics)
    unit = float(torch.cdist(centers, centers).max()) or depth
    points = torch.cat([path[:, :3, 3] / unit, path[:, :3, 2] / torch.pi], 1).numpy()
    done = np.append(0, np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum())
    if done[-1] < 1e-9:  # it does not move
        return camera_path(extrinsics, np.arange(frames) / frames, depth)
    shares = np.interp(even, done / done[-1], even)  # of the path's time, after equal parts of its length
    speeds = _speeds(np.stack([np.interp(shares, even, column) for column in points.T], 1))
    times = np.append(0, (2 / (speeds[1:] + speeds[:-1])).cumsum())
    return camera_path(extrinsics, np.interp(np.arange(frames) / frames, times / times[-1], shares), depth)


def _speeds(points: Array) -> Array:
    """Speeds in [0, 1] at points `(M, D)` at equal distances along a path; 0 at both ends."""
    part = 1 / (len(points) - 1)
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True).clip(1e-12)
    turns = np.arccos((steps[1:] * steps[:-1]).sum(1).clip(-1, 1)) / part  # one over the radius
    squares = np.append(np.append(0, np.minimum(1, _TURN / turns.clip(1e-9))), 0)
    gains = 2 * _TURN * part * np.arange(len(points))  # v^2 - 2 a s is constant while it accelerates
    squares[1:-1] = np.minimum.accumulate(squares[1:-1] - gains[1:-1]) + gains[1:-1]
    squares[1:-1] = (np.minimum.accumulate((squares[1:-1] + gains[1:-1])[::-1]))[::-1] - gains[1:-1]
    ends = np.linspace(0, 1, len(points)) / _RAMP
    speeds: Array = np.sqrt(np.minimum(squares, np.minimum(ends, ends[::-1])))
    return speeds


def camera_path(extrinsics: Tensor, shares: Array, depth: float) -> Tensor:
    """A smooth closed path through some cameras, as poses.

    The cameras are passed in the order of a short round trip. Between them, positions and quaternions are cubic splines
    that do not overshoot (F. Fritsch and J. Butland, SIAM J. Sci. Stat. Comput. 5, 1984): each coordinate stays between
    those of the neighbouring cameras. If the cameras look at a common point, the path follows arcs around this point
    and keeps looking at it. With two cameras, the path goes there and back; with one, it is a small ellipse. With more
    than twelve, some cameras are skipped.

    Convention:
        World-to-camera extrinsics with OpenCV axes, `(V, 4, 4)` in, V >= 1, and `(frames, 4, 4)` float64 out. A share
        of the path, `(frames,)`, is in [0, 1]: 0 is its beginning, a camera, and 1 the same point again, its end.
    """
    poses = torch.linalg.inv(extrinsics.double().cpu())  # camera to world
    if len(poses) == 1:  # a small ellipse beside it, looking at the point at `depth` on its optical axis
        angles = 2 * torch.pi * torch.from_numpy(shares)
        right, down, forward = poses[0, :3, :3].T
        offsets = _SWAY * depth * (angles.sin()[:, None] * right + 0.4 * (1 - angles.cos())[:, None] * down)
        return _extrinsics(poses[0, :3, 3] + offsets, _looking_at(depth * forward, offsets, down))
    order = _round_trip(_distances(poses))
    order = [order[i] for i in np.linspace(0, len(order), min(_STOPS, len(order)), endpoint=False).astype(int)]
    centers = poses[order, :3, 3]
    rotations = poses[order, :3, :3]
    focus = meeting_point(extrinsics[order])
    if focus is None:
        centers, rotations = _interpolated(centers, rotations, shares)
        return _extrinsics(centers, rotations)

    # Interpolate the direction and the distance from the focus, and the rotation relative to looking at it.
    down = -upright(extrinsics)[1]
    radii = (centers - focus).norm(dim=1, keepdim=True)
    rotations = _looking_at(focus, centers, down).mT @ rotations
    polar = torch.cat([(centers - focus) / radii, radii], 1)
    polar, rotations = _interpolated(polar, rotations, shares)
    centers = focus + polar[:, 3:] * normalize(polar[:, :3], dim=1)
    return _extrinsics(centers, _looking_at(focus, centers, down) @ rotations)


def _distances(poses: Tensor) -> Array:
    """Distances between camera-to-world poses, `(V, V)`: those of positions plus those of directions, each up to 1."""
    centers = poses[:, :3, 3].numpy()
    forward = poses[:, :3, 2].numpy()
    moved = np.linalg.norm(centers[:, None] - centers, axis=2)
    turned = np.arccos((forward @ forward.T).clip(-1, 1))
    distances: Array = moved / (moved.max() or 1.0) + turned / np.pi
    return distances


def _looking_at(target: Tensor, centers: Tensor, down: Tensor) -> Tensor:
    """Camera-to-world rotations `(F, 3, 3)` of cameras with these centres that look at a target, with `down` below."""
    forward = normalize(target - centers, dim=1)
    right = normalize(torch.linalg.cross(down.expand_as(forward), forward), dim=1)
    return torch.stack([right, torch.linalg.cross(forward, right), forward], 2)


def _extrinsics(centers: Tensor, rotations: Tensor) -> Tensor:
    """World-to-camera matrices `(F, 4, 4)` from positions and camera-to-world rotations."""
    poses = torch.eye(4, dtype=torch.float64).repeat(len(centers), 1, 1)
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = centers
    extrinsics: Tensor = torch.linalg.inv(poses)
    return extrinsics


def _round_trip(distances: Array) -> list[int]:
    """A short round trip through all points: always to the nearest one next, then improved by reversing sections."""
    order = [0]
    left = set(range(1, len(distances)))
    while left:
        order.append(min(left, key=lambda i: (distances[order[-1], i], i)))
        left.remove(order[-1])
    improved = True
    while improved:
        improved = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                a, b = order[i - 1], order[i]
                c, d = order[j], order[(j + 1) % len(order)]
                if distances[a, c] + distances[b, d] < distances[a, b] + distances[c, d] - 1e-9:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    improved = True
    return order


def _interpolated(vectors: Tensor, rotations: Tensor, shares: Array) -> tuple[Tensor, Tensor]:
    """Vectors `(V, D)` and rotations `(V, 3, 3)` along a closed path: `(frames, D)` and `(frames, 3, 3)`."""
    quaternions = rotation_matrix_to_quaternion(rotations.contiguous())
    rows = torch.from_numpy(_closed_spline(torch.cat([vectors, quaternions], 1).numpy(), shares))
    return rows[:, :-4], quaternion_to_rotation_matrix(rows[:, -4:])


def _closed_spline(stops: Array, shares: Array) -> Array:
    """Rows of a closed cubic spline through the stops `(V, D)`, which are at equal shares of it: `(frames, D)`.

    The last four columns are quaternions, not normalised. A tangent is the harmonic mean of the steps before and after
    its stop, or 0 where their signs differ.
    """
    n = len(stops)
    values = stops[np.arange(-1, n + 2) % n]  # the last stop, all stops, the first two again
    for previous, value in pairwise(values):
        if value[-4:] @ previous[-4:] < 0:  # q and -q are the same rotation: take the nearer one
            value[-4:] *= -1.0
    steps = np.diff(values, axis=0)
    products = steps[:-1] * steps[1:]
    tangents = np.divide(2 * products, steps[:-1] + steps[1:], out=np.zeros_like(products), where=products > 0)

    i = (n * shares).astype(int).clip(max=n - 1)  # which stop comes before
    u = (n * shares - i)[:, None]  # 0 at this stop, 1 at the next one
    bend = u * (1 - u) * ((1 - u) * tangents[i] - u * tangents[i + 1])
    rows: Array = values[i + 1] + u * u * (3 - 2 * u) * steps[i + 1] + bend
    return rows
