"""A film of a splat: a smooth path through the cameras, and its frames as a file that browsers play."""

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from kgs.datasets.scene import Views, pinholes
from kgs.geometry import meeting_point

from .cameras import upright
from .images import eight_bits

FRAMES = 90
RATE = 30.0  # frames a second
LONGEST = 640  # pixels of the longer side
MARK = b"kgs film"
_STOPS = 12  # cameras that a path of three seconds can pass
_SWAY = 0.03  # radius of the path of a single camera, in depths of the scene
Array = NDArray[np.float64]


def write_film(
    path: str | os.PathLike[str],
    render: Callable[[PinholeCamera], Tensor],
    views: Views,
    depth: float,
    stage: Callable[[Sequence[Any], str, str], Iterable[Any]] = lambda items, *_: items,
) -> str:
    """Write a film along the :func:`tour` through some views, a WebM file with VP8; it appears whole or not at all.

    It has `FRAMES` frames, `RATE` a second, and can be repeated without a jump. Its pictures are as large as the views,
    up to even numbers and to `LONGEST` pixels. (OpenCV's VP9 takes six times as long for half a decibel.)

    Args:
        path: the file to write, in a folder that exists.
        render: from one camera to a picture `(1, 3, H, W)`.
        views: those whose cameras are passed.
        depth: of the scene before the cameras, in world units.
        stage: shows how far the work is; :func:`kgs.io.console.each`, or nothing.

    Returns:
        "", or why there is no film: OpenCV cannot write such files here.
    """
    path = Path(path)
    height, width = views.images.shape[-2:]
    shrink = min(1.0, LONGEST / max(height, width))
    size = (max(2, 2 * round(height * shrink / 2)), max(2, 2 * round(width * shrink / 2)))
    scale = views.cameras.intrinsics.new_tensor([size[1] / width, size[0] / height])
    lens = views.cameras.intrinsics.mean(0)
    lens[:2] *= scale[:, None]
    lens[:2, 2] += (scale - 1) / 2  # (c + 1/2) s - 1/2: pixel centres are integers
    poses = tour(views.cameras.extrinsics, FRAMES, depth).to(lens)
    part = path.with_name(f".{path.name}")  # OpenCV goes by the ending
    try:
        with _silent():
            writer = cv2.VideoWriter(str(part), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"VP80"), RATE, size[::-1])
        if not writer.isOpened():
            return f"no {path.name}: this OpenCV writes no WebM files"
        for pose in stage(list(poses), "film", "frame"):
            image = render(pinholes(lens[None], pose[None], size))[0]
            writer.write(eight_bits(image))
        writer.release()
        if round(cv2.VideoCapture(str(part)).get(cv2.CAP_PROP_FRAME_COUNT)) != len(poses):
            return f"no {path.name}: it could not be written whole"
        with open(part, "ab") as file:  # an element of EBML that players skip
            file.write(b"\xec" + bytes([0x80 | len(MARK)]) + MARK)
        os.replace(part, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        part.unlink(missing_ok=True)
    return ""


def tour(extrinsics: Tensor, frames: int, depth: float) -> Tensor:
    """A smooth closed path through some cameras: their poses, and those between them.

    Positions and quaternions are cubic splines in the order of a short round trip, with slopes that never overshoot
    (F. Fritsch and J. Butland, SIAM J. Sci. Stat. Comput. 5, 1984): each coordinate stays between those of neighbouring
    cameras. Those that look at one point are passed on arcs around it, looking there, not on chords through it.
    From two cameras the path goes there and back, around a single one it sways. Of more than twelve some are passed.

    Convention:
        World-to-camera extrinsics, OpenCV axes, in and out. The first pose is that of one of the cameras.

    Args:
        extrinsics: `(V, 4, 4)`, V >= 1.
        frames: how many poses are wanted; after the last one the first follows.
        depth: of the scene before the cameras, in world units; for a single camera.

    Returns:
        `(frames, 4, 4)`, float64.
    """
    poses = torch.linalg.inv(extrinsics.double().cpu())
    centers, ahead = poses[:, :3, 3].numpy(), poses[:, :3, 2].numpy()
    if len(poses) == 1:
        return _sway(poses[0], frames, depth)
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)
    apart = apart / (apart.max() or 1.0) + np.arccos((ahead @ ahead.T).clip(-1, 1)) / np.pi
    order = _round_trip(apart)
    order = [order[i] for i in np.linspace(0, len(order), min(_STOPS, len(order)), endpoint=False).astype(int)]
    places, turns, focus = poses[order, :3, 3], poses[order, :3, :3], meeting_point(extrinsics[order])
    stops = torch.empty(len(order), 8, dtype=torch.float64)  # place, distance from the focus, quaternion
    stops[:, :3], stops[:, 3] = places, 1.0
    if focus is not None:  # the direction from there, and the rotation from looking there
        down = -upright(extrinsics)[1]
        stops[:, 3] = (places - focus).norm(dim=1)
        stops[:, :3] = (places - focus) / stops[:, 3:4]
        turns = _looking(places, focus, down).mT @ turns
    stops[:, 4:] = rotation_matrix_to_quaternion(turns.contiguous())
    times = np.array([apart[a, b] for a, b in zip(order, order[1:] + order[:1], strict=True)])
    found = torch.from_numpy(_closed_spline(stops.numpy(), times.clip(1e-6), frames))
    places, turns = found[:, :3], quaternion_to_rotation_matrix(found[:, 4:])
    if focus is not None:
        places = focus + found[:, 3:4] * normalize(places, dim=1)
        turns = _looking(places, focus, down) @ turns
    return _extrinsics(places, turns)


def _sway(pose: Tensor, frames: int, depth: float) -> Tensor:
    """A small ellipse before one camera, which keeps looking at what lies at the depth."""
    angles = 2 * torch.pi * torch.arange(frames, dtype=torch.float64) / frames
    right, down, ahead = pose[:3, :3].T
    places = _SWAY * depth * (angles.sin()[:, None] * right + 0.4 * (1 - angles.cos())[:, None] * down)
    return _extrinsics(pose[:3, 3] + places, _looking(places, depth * ahead, down))


def _looking(places: Tensor, target: Tensor, down: Tensor) -> Tensor:
    """Rotations from the camera's axes to the world's, `(F, 3, 3)`: ahead is the target, `down` is below."""
    ahead = normalize(target - places, dim=1)
    right = normalize(torch.linalg.cross(down.expand_as(ahead), ahead), dim=1)
    return torch.stack([right, torch.linalg.cross(ahead, right), ahead], 2)


def _extrinsics(places: Tensor, turns: Tensor) -> Tensor:
    poses = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
    poses[:, :3, :3], poses[:, :3, 3] = turns, places
    found: Tensor = torch.linalg.inv(poses)
    return found


def _round_trip(apart: Array) -> list[int]:
    """A short round trip through all: the nearest one next, then parts are turned around while that helps."""
    order, left = [0], set(range(1, len(apart)))
    while left:
        order.append(min(left, key=lambda i: (apart[order[-1], i], i)))
        left.remove(order[-1])
    better = True
    while better:
        better = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                a, b, c, d = order[i - 1], order[i], order[j], order[(j + 1) % len(order)]
                if apart[a, c] + apart[b, d] < apart[a, b] + apart[c, d] - 1e-9:
                    order[i : j + 1], better = order[i : j + 1][::-1], True
    return order


def _closed_spline(stops: Array, times: Array, frames: int) -> Array:
    """Rows `(frames, 8)` of the spline through the stops, evenly in time; the last four columns are quaternions."""
    n = len(stops)
    steps = times[np.arange(-1, n + 1) % n]
    values = stops[np.arange(-1, n + 2) % n]
    for i in range(1, n + 3):  # the nearer of the two quaternions of each rotation
        values[i, 4:] *= -1.0 if values[i, 4:] @ values[i - 1, 4:] < 0 else 1.0
    slopes = np.diff(values, axis=0) / steps[:, None]
    before, after, h, g = slopes[:-1], slopes[1:], steps[:-1, None], steps[1:, None]
    turns = before * after <= 0
    safe = np.where(turns, 1.0, before), np.where(turns, 1.0, after)
    tangents = np.where(turns, 0.0, 3 * (h + g) / ((2 * g + h) / safe[0] + (g + 2 * h) / safe[1]))
    ends = np.cumsum(times)
    moments = ends[-1] * np.arange(frames) / frames
    i = np.searchsorted(ends, moments, side="right").clip(max=n - 1)
    u = ((moments - ends[i]) / times[i] + 1)[:, None]
    parts = (1 + 2 * u) * (1 - u) ** 2 * values[i + 1] + u * u * (3 - 2 * u) * values[i + 2]
    rows: Array = parts + times[i, None] * (u * (1 - u) ** 2 * tangents[i] - u * u * (1 - u) * tangents[i + 1])
    return rows


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """What native code writes to stderr goes nowhere: OpenCV remarks on every WebM file."""
    kept, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)
