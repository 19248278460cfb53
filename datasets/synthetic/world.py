"""Puts meshes into a world, and computes their colours in daylight.

Things are made with z up; frames turn them into OpenCV's axes: x right, y down, z away from the viewer. Lengths are
metres.
"""

from collections.abc import Iterator, Sequence
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
CHUNK = 2048  # points at a time, so that all arrays stay in the cache
GAMMA = np.float32(1 / 2.2)  # colours are those of the picture, light is linear
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])  # from z up to OpenCV's axes


class Instance(NamedTuple):
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
    shell: int  # the first `shell` triangles (floor, walls) cast no shadow
    sun: Array  # (3,), towards the sun
    sky: Array  # (3,), towards the middle of the sky

    def prepare(self) -> None:
        """Make what all images share; threads that draw images would each make it for themselves."""
        for shared in ("lights", "normal_maps"):
            getattr(self, shared)

    @cached_property
    def lights(self) -> Lights:
        """The lamps, made for the first image."""
        sun, sky = (axis / np.linalg.norm(axis) for axis in (self.sun, self.sky))
        return daylight(self.triangles[self.shell :], sun, sky)

    @cached_property
    def normal_maps(self) -> Array:
        """For each triangle the matrix `(3, 4)` from a point `(x, y, z, 1)` on it to its normal, not yet of length 1.

        The normals at the corners are interpolated: the map is affine, and constant across the plane.
        """
        a, b, c = self.triangles.transpose(1, 0, 2)
        area = np.cross(b - a, c - a)
        square = (area**2).sum(axis=1)[:, None]
        weights = np.stack([np.cross(c - a, area), np.cross(area, b - a)], axis=1) / square[..., None]
        changes = self.normals[:, 1:] - self.normals[:, :1]
        linear = np.einsum("fki,fkj->fij", changes, weights)
        constant = self.normals[:, 0] - np.einsum("fij,fj->fi", linear, a)
        return np.concatenate([linear, constant[..., None]], axis=2)

    def shade(self, points: Array, faces: Index) -> Array:
        """Colours `(n, 3)` of points `(n, 3)` on triangles `(n,)`: daylight on the parts' textures."""
        colors = np.empty((len(points), 3))
        for owner, rows in self._rows_of_owners(faces):
            frame = self.frames[owner]
            local = ((points[rows] - frame[:3, 3]) @ frame[:3, :3]).astype(np.float32)
            colors[rows] = self.textures[owner](local)
        for start in range(0, len(points), CHUNK):
            chunk = slice(start, start + CHUNK)
            face = faces[chunk]
            light = received(self.lights, points[chunk], self._normals_at(points[chunk], face))
            colors[chunk] *= light**GAMMA
        return colors.clip(0.0, 1.0, out=colors)

    def _normals_at(self, points: Array, faces: Index) -> Array:
        """Unit normals `(n, 3)` at points `(n, 3)` on triangles `(n,)`."""
        maps = self.normal_maps[faces]
        normals = np.einsum("nij,nj->ni", maps[..., :3], points) + maps[..., 3]
        lengths: Array = np.sqrt(np.einsum("ni,ni->n", normals, normals))
        units: Array = normals / lengths[:, None]
        return units

    def _rows_of_owners(self, faces: Index) -> Iterator[tuple[int, Index]]:
        """The rows of each part that some triangles belong to, at most `CHUNK` at a time."""
        owners = self.owners[faces]
        counts = np.bincount(owners)
        order = np.argsort(owners.astype(np.uint16), kind="stable")  # 16 bits: numpy's radix sort
        for owner, stop in enumerate(np.cumsum(counts)):
            for start in range(stop - counts[owner], stop, CHUNK):
                yield owner, order[start : min(start + CHUNK, stop)]


def make_world(shell: Sequence[Instance], things: Sequence[Instance], sun: Array, sky: Array) -> World:
    """A world of things in a shell, which casts no shadow."""
    instances = [*shell, *things]
    meshes, frames, textures = zip(*instances, strict=True)
    triangles = [mesh.triangles @ frame[:3, :3].T + frame[:3, 3] for mesh, frame in zip(meshes, frames, strict=True)]
    normals = [_normals(mesh) @ frame[:3, :3].T for mesh, frame in zip(meshes, frames, strict=True)]
    sizes = [len(mesh.faces) for mesh in meshes]
    return World(
        np.concatenate(triangles),
        np.concatenate(normals),
        np.repeat(np.arange(len(meshes)), sizes),
        frames,
        textures,
        shell=sum(sizes[: len(shell)]),
        sun=sun,
        sky=sky,
    )


def put(
    parts: Sequence[Part], x: float, y: float, z: float = 0.0, turn: float = 0.0, upright: bool = False
) -> list[Instance]:
    """A thing at a position, turned about the vertical; if `upright`, it stands with its right side on top instead."""
    frame = euler_matrix(0.0, -np.pi / 2, 0.0) if upright else euler_matrix(0.0, 0.0, turn)
    frame[:3, 3] = x, y, z
    return [Instance(mesh, UPRIGHT @ frame, texture) for mesh, texture in parts]


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
