"""Scenes for tests of initial points: planes warped by homographies (the true depth is known), flat images, tracks."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera

from kgs.datasets.scene import Views
from kgs.init_points.tracks import Tracks

WIDTH, HEIGHT = 240, 180
SMALL = (80, 60)
CENTERS = np.array([[-0.4, 0.0, 0.0], [0.0, 0.15, 0.1], [0.4, -0.1, 0.0]])
BACK, FRONT = (6.0, 0.3), (3.0, -0.2)  # planes z = depth + slope x
BACK_TINT, FRONT_TINT = (1.0, 0.5, 0.25), (0.25, 0.5, 1.0)


def cameras(centers: np.ndarray = CENTERS, turn: float = -0.05, size: tuple[int, int] = (WIDTH, HEIGHT)):
    """Cameras that look along z, each turned a little about y, with an off-centre principal point."""
    (width, height), count = size, len(centers)
    intrinsics, extrinsics = torch.eye(4).repeat(count, 1, 1), torch.eye(4).repeat(count, 1, 1)
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = focal_length(width)
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = 0.51 * width, 0.49 * height
    for i, center in enumerate(centers):
        rotation = cv2.Rodrigues(np.array([0.0, turn * (i - (count - 1) / 2), 0.0]))[0]
        extrinsics[i, :3, :3] = torch.from_numpy(rotation)
        extrinsics[i, :3, 3] = torch.from_numpy(-rotation @ center)
    return PinholeCamera(intrinsics, extrinsics, torch.full((count,), height), torch.full((count,), width))


def focal_length(width: int) -> float:
    return 0.875 * width


def as_views(posed: PinholeCamera, images: torch.Tensor, masks: torch.Tensor | None = None) -> Views:
    return Views(posed, images, tuple(f"{i}.png" for i in range(len(images))), masks)


@cache
def texture(seed: int, tint: tuple[float, float, float], size: int = 900) -> np.ndarray:
    """Grey noise of several scales, in [0.1, 1], times a tint."""
    rng = np.random.default_rng(seed)
    noise = sum(
        s * cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), s) for s in (2.5, 5.0, 10.0)
    )
    grey = 0.1 + 0.9 * np.clip(0.5 + noise / (5 * noise.std()), 0, 1)
    painted: np.ndarray = grey[..., None] * np.array(tint, dtype=np.float32)
    painted.flags.writeable = False
    return painted


def painted_planes(posed: PinholeCamera | None = None) -> Views:
    """A reddish plane across the images of three cameras, and a bluish one before it over their upper left."""
    posed = cameras() if posed is None else posed
    width, height = int(posed.width[0]), int(posed.height[0])
    images = np.zeros((3, height, width, 3), dtype=np.float32)
    for (depth, slope), tint, seed, (left, top, side) in (
        (BACK, BACK_TINT, 1, (-6.0, -6.0, 12.0)),
        (FRONT, FRONT_TINT, 2, (-1.5, -1.2, 1.6)),
    ):
        painting = texture(seed, tint)
        step = side / len(painting)
        to_world = np.array([[step, 0, left], [0, step, top], [slope * step, 0, depth + slope * left]])
        for i in range(3):
            rotation, shift = posed.extrinsics[i, :3, :3].numpy(), posed.extrinsics[i, :3, 3].numpy()
            to_world_shifted = rotation @ to_world + shift[:, None] * np.array([[0, 0, 1]])
            homography = (posed.intrinsics[i, :3, :3].numpy() @ to_world_shifted).astype(np.float64)
            cv2.warpPerspective(
                painting, homography, (width, height), images[i], cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT
            )
    return as_views(posed, torch.from_numpy(images).permute(0, 3, 1, 2).contiguous())


def flat(posed: PinholeCamera | None = None) -> Views:
    """Images without a single feature."""
    posed = cameras(size=SMALL) if posed is None else posed
    return as_views(posed, torch.tensor([0.2, 0.4, 0.6])[:, None, None].repeat(posed.batch_size, 1, SMALL[1], SMALL[0]))


def exact_tracks(points: torch.Tensor) -> Tracks:
    posed = cameras()
    pixels = posed.project(points.float()[None].expand(3, -1, -1)).transpose(0, 1)
    return Tracks(pixels.double(), torch.ones(len(points), 3, dtype=torch.bool))
