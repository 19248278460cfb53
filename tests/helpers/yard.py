"""Boxes on a ground under a sky that is as good as infinitely far away: texture everywhere, exact depths."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from kgs.datasets import synthetic
from kgs.datasets.scene import Scene, Views
from kgs.datasets.synthetic.raycast import raycast
from kgs.datasets.synthetic.textures import field
from kgs.geometry.cameras import pinhole_cameras, select

CENTER = np.array([0.0, -0.75, 0.0])  # what the cameras look at: the horizon is in the middle of the image
ABOVE = np.array([[-0.45, -1.5, -1.6], [0.0, -1.725, -1.6], [0.45, -1.5, -1.6]])  # m from there, eyes that see no sky
RADIUS = 2.6  # m from the middle of the arc to its cameras
SPAN = np.radians(25.0)  # half of the arc
FOCAL = 0.9  # focal length over the longer side of the image
SKY_DISTANCE = 900.0  # m
FADE = 8.0  # m at which the ground has lost half its contrast, for pixels to resolve it
BOXES = (  # size and position of the middle, m
    ((1.4, 0.4, 0.6), (0.0, -0.2, 0.0)),
    ((0.3, 0.45, 0.3), (-0.45, -0.625, 0.05)),
    ((0.4, 0.25, 0.3), (0.35, -0.525, -0.1)),
    ((0.4, 0.5, 0.4), (-1.0, -0.25, 0.8)),
    ((0.3, 0.3, 0.3), (0.7, -0.15, -0.6)),
)
COLORS = np.array([[0.5, 0.65, 0.85], [0.65, 0.6, 0.5], [0.6, 0.4, 0.3], [0.7, 0.3, 0.3], [0.3, 0.5, 0.7]])


class Yard:
    """Triangles of the sky, the ground and the boxes, in this order, and their colours."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.coarse = field(rng, 0.3, 1.2)
        self.fine = field(rng, 0.04, 0.2)
        sky = trimesh.creation.icosphere(subdivisions=1, radius=SKY_DISTANCE)
        ground = trimesh.creation.box((4 * SKY_DISTANCE, 1.0, 4 * SKY_DISTANCE)).apply_translation((0.0, 0.5, 0.0))
        boxes = [trimesh.creation.box(size).apply_translation(middle) for size, middle in BOXES]
        meshes = [sky, ground, *boxes]
        self.triangles = np.concatenate([mesh.triangles for mesh in meshes])
        self.owners = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])

    def shade(self, points: Any, faces: Any) -> Any:
        """Colours `(n, 3)` of points on triangles."""
        owners = self.owners[faces]
        distances = np.linalg.norm(points, axis=1, keepdims=True)
        points = np.where(owners[:, None] == 0, points / distances, points).astype(np.float32)
        contrast = np.where(owners == 1, 1 / (1 + (distances[:, 0] / FADE) ** 2), 1.0)
        light = 1.0 + contrast * (0.12 * self.coarse(points) + np.where(owners > 0, 0.2, 0.0) * self.fine(points))
        return (COLORS[owners % len(COLORS)] * light[:, None]).clip(0.0, 1.0)


make_yard = cache(Yard)


def yard_views(eyes: Any, size: tuple[int, int], seed: int = 0, name: str = "photo") -> Views:
    """Images from positions `(V, 3)` relative to the middle."""
    intrinsics = torch.eye(4).repeat(len(eyes), 1, 1)
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = FOCAL * max(size)
    intrinsics[:, 0, 2] = (size[1] - 1) / 2
    intrinsics[:, 1, 2] = (size[0] - 1) / 2
    extrinsics = torch.zeros(len(eyes), 4, 4)
    for pose, eye in zip(extrinsics, CENTER + eyes, strict=True):
        pose[:] = torch.from_numpy(synthetic._look_at(eye, CENTER))
    images = torch.zeros(len(eyes), 3, *size)
    cameras = pinhole_cameras(extrinsics, intrinsics, *size[::-1])
    for i, image in enumerate(images):
        image[:] = torch.from_numpy(synthetic._render(make_yard(seed), select(cameras, i), size))
    return Views(cameras, images, tuple(f"{name}_{i:02d}" for i in range(len(eyes))))


def yard_depths(views: Views, seed: int = 0) -> torch.Tensor:
    """The true depths `(V, H, W)`, float64."""
    cameras = views.cameras
    matrices = zip(cameras.intrinsics.double().numpy(), cameras.extrinsics.double().numpy(), strict=True)
    size = views.images.shape[-2], views.images.shape[-1]
    return torch.from_numpy(np.stack([raycast(make_yard(seed).triangles, *pair, size)[0] for pair in matrices]))


def on_arc(angles: Any, heights: Any) -> Any:
    """Eyes at angles in radians and heights in metres."""
    return np.stack([RADIUS * np.sin(angles), -np.asarray(heights), -RADIUS * np.cos(angles)], axis=-1)


def yard_scene(train: int = 6, test: int = 2, size: tuple[int, int] = (72, 96)) -> Scene:
    """Training views on an arc before the boxes, in a zigzag, and test views between them."""
    angles = np.linspace(-SPAN, SPAN, train)
    between = np.linspace(-0.8 * SPAN, 0.7 * SPAN, test)
    views = yard_views(on_arc(angles, np.where(np.arange(train) % 2, 0.06, -0.06)), size, name="train")
    held_out = yard_views(on_arc(between, np.linspace(0.04, -0.04, test)), size, name="test")
    none = torch.zeros(0, 3)
    return Scene(views, held_out, none, none, "none", torch.zeros(3).double(), torch.zeros(3), Path("yard"))


def yard_from_above(size: tuple[int, int], seed: int = 0) -> tuple[Views, torch.Tensor]:
    """Three views with texture everywhere and without sky, and their true depths `(3, H, W)`."""
    views = yard_views(ABOVE, size, seed)
    return views, yard_depths(views, seed)
