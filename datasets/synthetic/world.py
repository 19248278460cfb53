"""Places meshes in a world, and computes their colours in daylight.

Things are made with z up; frames turn them into OpenCV's axes: x right, y down, z away from the viewer. Lengths are
metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import trimesh
from trimesh.transformations import euler_matrix

from .furniture import Part
from .light import Lights, daylight, received
from .raycast import Array, Index
from .textures import Texture

CREASE = np.cos(np.radians(40.0))  # faces that meet at a larger angle are not smoothed into each other
GAMMA = np.float32(1 / 2.2)  # colours are those of the picture, light is linear
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])  # from z up to OpenCV's axes


class Placed(NamedTuple):
    """A mesh in its own frame, the frame `(4, 4)` in the world, and the mesh's colours."""

    mesh: trimesh.Trimesh
    frame: Array
    texture: Texture


@dataclass(frozen=True, eq=False)
class World:
    """F triangles that belong to some parts, each with its own frame and texture."""

    triangles: Array  # (F, 3, 3)
    normals: Array  # (F, 3, 3), unit, at the corners
    owners: Index  # (F,), the part a triangle belongs to
    frames: tuple[Array, ...]  # a (4, 4) rigid matrix for each part, from its own frame to the world
    textures: tuple[Texture, ...]
    shell: int  # the first `shell` triangles (ground, walls, sky) cast no shadow
    sun: Array  # (3,), towards the sun
    sky: Array  # (3,), towards the middle of the sky
    unlit: int  # the first `unlit` triangles are not lit: their colours are those of their textures

    @cached_property
    def lights(self) -> Lights:
        """The lamps, made for the first image."""
        sun, sky = (axis / np.linalg.norm(axis) for axis in (self.sun, self.sky))
        return daylight(self.triangles[self.shell :], sun, sky)

    def shade(self, points: Array, faces: Index) -> Array:
        """Colours `(n, 3)` of points `(n, 3)` on triangles `(n,)`: daylight on the parts' textures."""
        owners = self.owners[faces]
        colors = np.empty((len(points), 3))
        for owner in np.unique(owners):
            rows = np.flatnonzero(owners == owner)
            frame = self.frames[owner]
            colors[rows] = self.textures[owner](((points[rows] - frame[:3, 3]) @ frame[:3, :3]).astype(np.float32))
        light = received(self.lights, points, _between(self.triangles[faces], self.normals[faces], points))
        light[faces < self.unlit] = 1.0
        return np.asarray(colors * light**GAMMA).clip(0.0, 1.0)


def make_world(
    shell: Sequence[Placed], things: Sequence[Placed], sun: Array, sky: Array, unlit: Sequence[Placed] = ()
) -> World:
    """A world of things in a shell, which casts no shadow, and of unlit parts, which cast none either."""
    placed = [*unlit, *shell, *things]
    meshes, frames, textures = zip(*placed, strict=True)
    triangles = [mesh.triangles @ frame[:3, :3].T + frame[:3, 3] for mesh, frame in zip(meshes, frames, strict=True)]
    normals = [_normals(mesh) @ frame[:3, :3].T for mesh, frame in zip(meshes, frames, strict=True)]
    sizes = [len(mesh.faces) for mesh in meshes]
    return World(
        np.concatenate(triangles),
        np.concatenate(normals),
        np.repeat(np.arange(len(meshes)), sizes),
        frames,
        textures,
        shell=sum(sizes[: len(unlit) + len(shell)]),
        sun=sun,
        sky=sky,
        unlit=sum(sizes[: len(unlit)]),
    )


def put(
    parts: Sequence[Part], x: float, y: float, z: float = 0.0, turn: float = 0.0, upright: bool = False
) -> list[Placed]:
    """A thing at a place, turned about the vertical; if `upright`, it stands with its right side on top instead."""
    frame = euler_matrix(0.0, -np.pi / 2, 0.0) if upright else euler_matrix(0.0, 0.0, turn)
    frame[:3, 3] = x, y, z
    return [Placed(mesh, UPRIGHT @ frame, texture) for mesh, texture in parts]


def _normals(mesh: trimesh.Trimesh) -> Array:
    """Unit normals `(F, 3, 3)` at the corners: the mean of the faces around the vertex that lie within the crease."""
    corners = mesh.faces.ravel()
    order = np.argsort(corners, kind="stable")
    first = np.searchsorted(corners[order], np.arange(len(mesh.vertices) + 1))
    slots = first[corners][:, None] + np.arange(np.diff(first).max())
    there = slots < first[corners + 1][:, None]
    around = order[np.where(there, slots, 0)] // 3  # (3F, K) for at most K faces around a vertex
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
