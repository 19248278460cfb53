"""The room of the synthetic scene: a table with books, a lamp, a plant and a mug before a wall with a picture.

Titles, colours, pictures and leaves derive from the seed, and so do small differences of place: every seed shows the
same kinds of things. Furniture stands with z up; frames turn it into OpenCV's axes: x right, y down, z away from the
viewer. The floor is y = 0; lengths are metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from trimesh.transformations import euler_matrix

from . import furniture as make
from .light import Lights, daylight, received
from .pictures import landscape, outlook, rug, tone
from .raycast import Array, Index
from .textures import Array as Numbers
from .textures import Texture, field

EYE = np.array([0.0, -0.82, 0.0])  # the middle of the cameras
PATCH = np.array([0.3, 0.12, 0.04])  # half the extent of the training cameras
CENTER = np.array([0.0, -0.6, 1.75])  # what they look at
FOCAL = 0.9  # focal length over the longer side of the image
SUN = np.array([-0.42, -0.62, -0.66])  # unit vectors towards the sun and the middle of the sky
SKY = np.array([0.1, -0.75, -0.65])
CREASE = np.cos(np.radians(40.0))  # faces that meet at a larger angle are not smoothed into each other
GAMMA = np.float32(1 / 2.2)  # colours are those of the picture, light is linear
WALL, TABLE = 2.5, 0.42  # z of the wall, and the height of the table's top
TITLES = ("ATLAS", "BIRDS", "MOON", "TREES", "STARS", "RIVERS", "BREAD", "MUSIC", "CHESS", "SNOW", "OCEAN", "HORSES")
HUES = (0.0, 0.58, 0.11, 0.36, 0.07, 0.76, 0.48, 0.95, 0.63, 0.27, 0.03, 0.54)  # of the books
INKS = ((247, 235, 204), (250, 209, 102))
WHITE = (237, 232, 219)
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])  # from z up to OpenCV's axes

_Placed = tuple[trimesh.Trimesh, Array, Texture]  # a mesh in its own frame, the frame in the world, the mesh's colours


@dataclass(frozen=True, eq=False)
class Room:
    """F triangles that belong to some parts, each of which has a frame and a texture of its own."""

    triangles: Array  # (F, 3, 3)
    normals: Array  # (F, 3, 3), unit, at the corners
    owners: Index  # (F,), the part a triangle belongs to
    frames: tuple[Array, ...]  # a (4, 4) rigid matrix for each part, from its own frame to the world
    textures: tuple[Texture, ...]
    shell: int  # so many of the first triangles are floor and walls, which cast no shadow

    @cached_property
    def lights(self) -> Lights:
        """The lamps: made when a picture is."""
        return daylight(self.triangles[self.shell :], SUN / np.linalg.norm(SUN), SKY / np.linalg.norm(SKY))

    def shade(self, points: Array, faces: Index) -> Array:
        """Colours `(n, 3)` of points `(n, 3)` on triangles `(n,)`: daylight on the parts' textures."""
        owners, colors = self.owners[faces], np.empty((len(points), 3))
        for owner in np.unique(owners):
            rows, frame = np.flatnonzero(owners == owner), self.frames[owner]
            colors[rows] = self.textures[owner](((points[rows] - frame[:3, 3]) @ frame[:3, :3]).astype(np.float32))
        light = received(self.lights, points, _between(self.triangles[faces], self.normals[faces], points))
        return np.asarray(colors * light**GAMMA).clip(0.0, 1.0)


def make_room(seed: int) -> Room:
    """The room of a seed."""
    rng = np.random.default_rng([seed, 2])
    shell = _shell(rng)
    meshes, frames, textures = zip(*shell, *_things(rng), strict=True)
    triangles = [mesh.triangles @ frame[:3, :3].T + frame[:3, 3] for mesh, frame in zip(meshes, frames, strict=True)]
    normals = [_normals(mesh) @ frame[:3, :3].T for mesh, frame in zip(meshes, frames, strict=True)]
    sizes = [len(mesh.faces) for mesh in meshes]
    owners, count = np.repeat(np.arange(len(meshes)), sizes), sum(sizes[: len(shell)])
    return Room(np.concatenate(triangles), np.concatenate(normals), owners, frames, textures, count)


def _shell(rng: np.random.Generator) -> list[_Placed]:
    """Floor, wall, rug, window and picture: nothing stands behind or under them."""
    boards, oak = make.wood(rng, (158, 107, 66), plank=0.14), make.wood(rng, (102, 61, 33))
    skirting = make.Part(make.box((9.0, 0.02, 0.09), (0, -0.01, 0.045)), make.plain(WHITE))
    carpet = make.printed(rug(rng, 1.9, 1.1), 1.9, 1.1, axes=(0, 1))
    window = make.framed(outlook(rng, 0.7, 0.8), 0.7, 0.8, make.plain(WHITE), 0.05) + make.bars(0.7, 0.8, WHITE)
    return [
        *_put([make.sheet(9.0, 6.0, boards)], 0.0, 2.0),
        *_put([make.sheet(9.0, 6.0, _wallpaper(rng), axis=2)], 0.0, WALL, 1.5),
        *_put([skirting], 0.0, WALL),
        *_put([make.sheet(1.9, 1.1, carpet)], 0.05, 1.75, 0.01),
        *_put(window, -0.62, WALL, 1.15),
        *_put(make.framed(landscape(rng, 0.72, 0.5), 0.72, 0.5, oak), 0.42, WALL, 1.13),
    ]


def _things(rng: np.random.Generator) -> list[_Placed]:
    """The table with what stands on it, and a ball under it; near the places named here."""
    placed = _put(make.table(rng, 1.7, 0.62, TABLE), 0.0, 1.75)
    titles = rng.permutation(TITLES)
    covers = [tone(hue, rng.uniform(0.65, 0.8), rng.uniform(0.5, 0.75)) for hue in rng.permutation(HUES)]
    x, z = -0.47, TABLE
    for k in range(9):  # six that stand in a row, and a pile of three
        length, thickness = rng.uniform(0.3, 0.36), rng.uniform(0.062, 0.078)
        book = make.book(titles[k], length, 0.22, thickness, covers[k], INKS[k % 2])
        if k < 6:
            placed += _put(book, x, 1.78, TABLE + length / 2, upright=True)
            x += thickness + 0.002
        else:
            placed += _put(book, 0.22, 1.72, z, rng.uniform(-0.15, 0.15))
            z += thickness
    sectors = [(217, 51, 41), (247, 204, 64), (41, 115, 178), (242, 237, 224)] * 2
    things = [
        (make.mug(tone(rng.choice([0.55, 0.0, 0.45]), 0.65, 0.75)), 0.2, 1.7, z, 0.4),
        (make.lamp((252, 219, 153)), -0.66, 1.8, TABLE, 0.0),
        (make.plant(rng), 0.62, 1.7, TABLE, 3.0),
        (make.ball(0.042, [(204, 31, 26)]), -0.12, 1.53, TABLE, 0.0),
        (make.ball(0.14, sectors), 0.42, 1.6, 0.01, 0.4),
    ]
    for parts, x, y, z, turn in things:
        shift = rng.uniform(-0.025, 0.025, size=2)
        placed += _put(parts, x + shift[0], y + shift[1], z, rng.uniform(-turn, turn))
    return placed


def _put(
    parts: Sequence[make.Part], x: float, y: float, z: float = 0.0, turn: float = 0.0, upright: bool = False
) -> list[_Placed]:
    """A thing at a place, turned about the vertical; upright: what is to its right as it lies is then its top."""
    frame = euler_matrix(0.0, -np.pi / 2, 0.0) if upright else euler_matrix(0.0, 0.0, turn)
    frame[:3, 3] = x, y, z
    return [(mesh, UPRIGHT @ frame, texture) for mesh, texture in parts]


def _wallpaper(rng: np.random.Generator) -> Texture:
    """Small diamonds in rows that are shifted by half, on a warm ground."""
    cloud, hue = field(rng, 0.15, 0.8), rng.choice([0.09, 0.11, 0.13])
    ground, motif = make.albedo(tone(hue, 0.24, 0.93)), make.albedo(tone(hue, 0.36, 0.86))

    def texture(points: Numbers) -> Numbers:
        x, z = points[:, 0] / 0.16, points[:, 2] / 0.16
        z = z + 0.5 * (np.floor(x) % 2)
        inside = np.abs(x % 1 - 0.5) + np.abs(z % 1 - 0.5) < 0.2
        return np.asarray(np.where(inside[:, None], motif, ground) * (1 + 0.025 * cloud(points))[:, None])

    return texture


def _normals(mesh: trimesh.Trimesh) -> Array:
    """Unit normals `(F, 3, 3)` at the corners: the mean of the faces around the vertex that lie within the crease."""
    corners = mesh.faces.ravel()
    order = np.argsort(corners, kind="stable")
    first = np.searchsorted(corners[order], np.arange(len(mesh.vertices) + 1))
    slots = first[corners][:, None] + np.arange(np.diff(first).max())
    there = slots < first[corners + 1][:, None]
    around = order[np.where(there, slots, 0)] // 3  # (3F, most faces around a vertex)
    own = np.repeat(mesh.face_normals, 3, axis=0)[:, None]
    weights = mesh.area_faces[around] * there * ((mesh.face_normals[around] * own).sum(-1) > CREASE)
    sums = (weights[..., None] * mesh.face_normals[around]).sum(axis=1)
    return np.asarray(sums / np.linalg.norm(sums, axis=1, keepdims=True)).reshape(-1, 3, 3)


def _between(triangles: Array, normals: Array, points: Array) -> Array:
    """Unit normals `(n, 3)`: those at the corners `(n, 3, 3)`, interpolated at points `(n, 3)` of the triangles."""
    a, b, c = triangles.transpose(1, 0, 2)
    area = np.cross(b - a, c - a)
    square = (area**2).sum(axis=1)
    second = (np.cross(points - a, c - a) * area).sum(axis=1) / square
    third = (np.cross(b - a, points - a) * area).sum(axis=1) / square
    mixed = np.einsum("nk,nkd->nd", np.stack([1 - second - third, second, third], axis=-1), normals)
    return np.asarray(mixed / np.linalg.norm(mixed, axis=1, keepdims=True))
