"""Furniture of the synthetic room: meshes of trimesh, and a colour for each point on them.

Each thing stands on z = 0 in its own frame: x to the right, y away from the viewer, z up, in metres.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch.nn.functional import grid_sample

from .pictures import Color, Picture, spine
from .textures import Array, Texture, field


class Part(NamedTuple):
    """A mesh and its texture, from points `(n, 3)` of the mesh's frame to colours `(n, 3)` in [0, 1]."""

    mesh: trimesh.Trimesh
    texture: Texture


def albedo(color: Color) -> NDArray[np.float32]:
    """A colour in [0, 1], `(3,)`."""
    return np.array(color, dtype=np.float32) / np.float32(255)


def plain(color: Color) -> Texture:
    """One colour everywhere."""
    return lambda points: np.broadcast_to(albedo(color), (len(points), 3))


def wood(rng: np.random.Generator, color: Color, along: int = 0, plank: float = np.inf) -> Texture:
    """Wood with its grain along one axis; in planks `plank` metres wide, each of its own shade, if a width is given."""
    grain = field(rng, 0.02, 0.09)
    cloud = field(rng, 0.2, 0.6)
    shades = rng.normal(size=64)
    stretch = np.where(np.arange(3) == along, 0.08, 1.0).astype(np.float32)

    def texture(points: Array) -> Array:
        across = points[:, 1 - along] / plank
        board = np.floor(across).astype(np.int64)
        light = 1.0 + 0.07 * grain(points * stretch + board[:, None] * np.float32(0.37)) + 0.03 * cloud(points)
        if np.isfinite(plank):
            light += 0.07 * shades[board % 64]
            light *= 1.0 - 0.45 * (np.abs(across - board - 0.5) > 0.5 - 0.003 / plank)
        return np.asarray(light[:, None] * albedo(color))

    return texture


def printed(picture: Picture, width: float, height: float, axes: Sequence[int] = (0, 2)) -> Texture:
    """A picture on a rectangle around the origin, spanned by two axes; beyond it the picture's border is repeated."""
    # torch would divide integers into its default dtype, and the texture is cached
    levels = np.ascontiguousarray(picture[::-1].transpose(2, 0, 1), dtype=np.float32)
    image = torch.from_numpy(levels)[None] / 255
    half = np.array([width, height], dtype=np.float32) / 2

    def texture(points: Array) -> Array:
        grid = torch.from_numpy(points[:, list(axes)] / half)[None, None]
        return grid_sample(image, grid, padding_mode="border", align_corners=False)[0, :, 0].T.numpy()

    return texture


def box(size: Sequence[float], center: Sequence[float]) -> trimesh.Trimesh:
    """A box with its edges along the axes."""
    mesh: trimesh.Trimesh = trimesh.creation.box(size).apply_translation(center)
    return mesh


def lathe(profile: Sequence[tuple[float, float]], sections: int = 40) -> trimesh.Trimesh:
    """A body of revolution about z: (radius, height) from the bottom up on the outside, and back on the inside."""
    return trimesh.creation.revolve(profile, sections=sections)


def table(rng: np.random.Generator, width: float, depth: float, height: float) -> list[Part]:
    """A low table with tapered legs."""
    oak = wood(rng, (173, 115, 64))
    parts = [
        Part(box((width, depth, 0.045), (0, 0, height - 0.0225)), oak),
        Part(box((width - 0.12, depth - 0.1, 0.07), (0, 0, height - 0.08)), wood(rng, (148, 94, 51))),
    ]
    for x in (-1, 1):
        for y in (-1, 1):
            leg = lathe([(0.0, 0.0), (0.017, 0.0), (0.03, height - 0.045), (0.0, height - 0.045)], 16)
            offset = x * (width / 2 - 0.09), y * (depth / 2 - 0.08), 0.0
            parts.append(Part(leg.apply_translation(offset), wood(rng, (153, 97, 51), along=2)))
    return parts


def book(title: str, length: float, depth: float, thickness: float, cover: Color, ink: Color) -> list[Part]:
    """A book that lies on its back cover, its spine towards the viewer, its pages on the other three sides."""
    back = printed(spine(title, length, thickness, cover, ink), length, thickness)
    size = (length, depth, thickness)
    half = np.array(size) / 2

    def texture(points: Array) -> Array:
        centered = (points - [0.0, 0.0, half[2]]).astype(np.float32)
        edge = np.abs(centered) > half - 1e-5
        paper = (edge[:, 0] | (centered[:, 1] > half[1] - 1e-5)) & (np.abs(centered[:, 2]) < half[2] - 0.006)
        lines = 0.86 + 0.06 * np.sin(1500.0 * centered[:, 2:])
        colors = np.where(paper[:, None], lines * [1.0, 0.96, 0.86], albedo(cover))
        return np.where((centered[:, 1] < -half[1] + 1e-5)[:, None], back(centered), colors)

    return [Part(box(size, (0, 0, thickness / 2)), texture)]


def lamp(color: Color) -> list[Part]:
    """A table lamp: foot, stem and a shade of cloth."""
    brass = plain((184, 140, 71))
    foot = lathe([(0.0, 0.0), (0.085, 0.0), (0.08, 0.018), (0.02, 0.03), (0.011, 0.05), (0.011, 0.36), (0.0, 0.36)])
    cloth = lathe([(0.15, 0.3), (0.092, 0.5), (0.088, 0.5), (0.146, 0.3), (0.15, 0.3)], 48)
    return [Part(foot, brass), Part(cloth, plain(color))]


def mug(color: Color) -> list[Part]:
    """A mug of tea with its handle to the right and a white rim."""
    cup = lathe([(0.0, 0.0), (0.046, 0.0), (0.052, 0.008), (0.052, 0.108), (0.047, 0.11), (0.046, 0.09), (0.0, 0.09)])
    handle = trimesh.creation.torus(0.033, 0.009, major_sections=24, minor_sections=10)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    white = albedo((245, 240, 230))
    tea = albedo((107, 51, 18))
    glaze = albedo(color)

    def texture(points: Array) -> Array:
        inside = np.hypot(points[:, 0], points[:, 1]) < 0.0475
        colors = np.where(points[:, 2:] > 0.1, white, glaze)
        colors = np.where((np.abs(points[:, 2:] - 0.055) < 0.012), white, colors)
        return np.where((inside & (points[:, 2] > 0.05))[:, None], tea, colors)

    return [Part(cup, texture), Part(handle.apply_translation([0.058, 0.0, 0.057]), plain(color))]


def plant(rng: np.random.Generator) -> list[Part]:
    """Leaves that rise from a pot of clay and bend outwards."""
    clay = plain((194, 102, 66))
    soil = plain((51, 33, 23))
    pot = [(0.0, 0.0), (0.07, 0.0), (0.1, 0.13), (0.113, 0.13), (0.113, 0.165), (0.098, 0.165), (0.095, 0.14)]
    parts = [Part(lathe(pot), clay), Part(lathe([(0.1, 0.145), (0.0, 0.15)]), soil)]
    for k in range(20):
        length = rng.uniform(0.3, 0.42)
        width = rng.uniform(0.034, 0.046)
        lean = 0.12 + 0.75 * (k / 19) + rng.uniform(-0.05, 0.05)
        bend = rng.uniform(0.4, 0.9)
        turn = 2.4 * k + rng.uniform(-0.3, 0.3)
        hue = rng.uniform(-0.04, 0.04)
        parts.append(Part(_leaf(length, width, lean, bend, turn), _leaf_green(turn, hue)))
    return parts


def _leaf(length: float, width: float, lean: float, bend: float, turn: float) -> trimesh.Trimesh:
    """A flat ball whose long axis is bent: from `lean` to `lean + bend` radians off the vertical, about z by `turn`."""
    ball = trimesh.creation.uv_sphere(count=[14, 12])
    x, y, z = ball.vertices.T
    t = (1.0 + z) / 2  # from the root to the tip
    angle = lean + bend * t
    along = length * np.stack([np.cos(lean) - np.cos(angle), np.sin(angle) - np.sin(lean)], axis=-1) / bend
    blade = np.sqrt((1 - z**2).clip(1e-9))
    side = width * np.sin(np.pi * t**1.3) ** 0.8 * x / blade
    thick = 0.004 * y
    outward = along[:, 0] + thick * np.cos(angle) + 0.25 * np.abs(side) * np.cos(angle)
    up = along[:, 1] - thick * np.sin(angle) + 0.25 * np.abs(side)
    c, s = np.cos(turn), np.sin(turn)
    vertices = np.stack([c * outward - s * side, s * outward + c * side, up + 0.14], axis=-1)
    return trimesh.Trimesh(vertices, ball.faces, process=False)


def _leaf_green(turn: float, hue: float) -> Texture:
    """Green with a light midrib; `turn` is that of the leaf."""

    def texture(points: Array) -> Array:
        side = np.abs(points[:, 1] * np.cos(turn) - points[:, 0] * np.sin(turn))
        rib = np.exp(-((side / 0.004) ** 2))[:, None]
        green = np.array([0.2 + hue, 0.5 + hue, 0.2])
        return np.asarray(green * (1 - rib) + np.array([0.55, 0.75, 0.4]) * rib)

    return texture


def framed(picture: Picture, width: float, height: float, border: Texture, rim: float = 0.04) -> list[Part]:
    """A picture around the origin in a frame that stands out from the wall behind it, y = 0."""
    parts = [sheet(width, height, printed(picture, width, height), axis=2)]
    parts[0].mesh.apply_translation([0, -0.01, 0])
    for side in (-1, 1):
        parts.append(Part(box((rim, 0.035, height + 2 * rim), (side * (width + rim) / 2, -0.0175, 0)), border))
        parts.append(Part(box((width, 0.035, rim), (0, -0.0175, side * (height + rim) / 2)), border))
    return parts


def bars(width: float, height: float, color: Color) -> list[Part]:
    """The crossed bars of a window."""
    upright, level = (0.025, 0.025, height), (width, 0.025, 0.025)
    return [Part(box(size, (0, -0.0125, 0)), plain(color)) for size in (upright, level)]


def ball(radius: float, colors: Sequence[Color]) -> list[Part]:
    """A ball of sectors in these colours, with white caps."""
    panels = np.array([albedo(color) for color in colors])

    def texture(points: Array) -> Array:
        sector = np.floor(np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) * len(panels)).astype(np.int64)
        cap = np.abs(points[:, 2:] - radius) > 0.93 * radius
        return np.where(cap, np.float32(0.95), panels[sector % len(panels)])

    return [Part(trimesh.creation.icosphere(subdivisions=3, radius=radius).apply_translation([0, 0, radius]), texture)]


def sheet(width: float, height: float, texture: Texture, axis: int = 1) -> Part:
    """Two triangles around the origin: on the ground, or with axis 2 upright and towards the viewer."""
    corners = np.zeros((4, 3))
    corners[:, [0, axis]] = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2 * [width, height]
    return Part(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False), texture)
