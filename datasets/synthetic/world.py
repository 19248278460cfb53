"""The world of the synthetic scene: trimesh's meshes, where they stand, and the colour of every point of them."""

from typing import NamedTuple

import numpy as np
import trimesh
from trimesh.transformations import euler_matrix

from .raycast import Array, Index
from .textures import Texture, random_texture

FLOOR = 1.2  # y of the floor
CENTER = np.array([0.0, 0.5, 4.4])  # the middle of the objects
LIGHT = np.array([-0.48, -0.6, -0.64])  # unit vector towards the light: to the left, above and before the objects


class World(NamedTuple):
    """F triangles that belong to some parts, each of which has a frame and a texture of its own."""

    triangles: Array  # (F, 3, 3)
    normals: Array  # (F, 3), unit
    owners: Index  # (F,), the part a triangle belongs to
    frames: tuple[Array, ...]  # a (4, 4) rigid matrix for each part, from its own frame to the world
    textures: tuple[Texture, ...]
    balls: Array  # (B, 4), centre and radius of a ball as large as each of the first B parts: they shade what is near


_Part = tuple[trimesh.Trimesh, Array, Texture]


def make_world(kind: str, seed: int) -> World:
    """The world: "forward" in a room that fills the view, "orbit" on a square of floor with nothing around it.

    Its axes are OpenCV's; the forward-facing cameras stand around the origin.
    """
    rng = np.random.default_rng([seed, 0])
    parts = _objects(rng)
    balls = [[*mesh.bounds.mean(axis=0), 0.5 * np.prod(mesh.extents) ** (1 / 3)] for mesh, _, _ in parts]
    if kind == "forward":
        parts += [_wall(rng), _floor((-9.0, 9.0), (0.8, 7.5), rng)]
    else:
        parts += [_floor((-3.2, 3.2), (CENTER[2] - 3.2, CENTER[2] + 3.2), rng)]
    meshes, frames, textures = zip(*parts, strict=True)
    triangles = np.concatenate([mesh.triangles for mesh in meshes])
    normals = np.concatenate([mesh.face_normals for mesh in meshes])
    owners = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    return World(triangles, normals, owners, frames, textures, np.array(balls))


def shade(world: World, points: Array, faces: Index) -> Array:
    """Colours `(n, 3)` of points `(n, 3)` on triangles `(n,)`, lit by the sky and one distant light (Lambert)."""
    owners, normals = world.owners[faces], world.normals[faces]
    albedo = np.empty((len(points), 3))
    for owner in np.unique(owners):
        rows, frame = np.flatnonzero(owners == owner), world.frames[owner]
        albedo[rows] = world.textures[owner](((points[rows] - frame[:3, 3]) @ frame[:3, :3]).astype(np.float32))
    light = 0.65 - 0.1 * normals[:, 1] + 0.45 * (normals @ LIGHT).clip(0.0)
    light *= _openness(world.balls, points, normals, owners)
    return np.asarray(albedo * light[:, None]).clip(0.0, 1.0)


def _objects(rng: np.random.Generator) -> list[_Part]:
    """Things on the floor between z = 2.5 and 6.2, the near ones hiding some of the far ones."""
    make = trimesh.creation
    upright = np.pi / 2  # turns trimesh's axis of revolution, z, into the vertical
    turns = rng.uniform(-0.4, 0.4, size=4)
    # mesh, (x, height above the floor, z), turn about x, turn about y, texture
    layout = [
        (make.icosphere(subdivisions=4, radius=0.42), (-0.75, 0.42, 3.3), 0.0, 0.0, "marble"),
        (make.box((0.8, 0.8, 0.8)), (0.85, 0.4, 3.9), 0.0, 0.6 + turns[0], "tiles"),
        (make.box((0.5, 0.5, 0.5)), (0.8, 1.05, 3.95), 0.0, 0.2 + turns[1], "stone"),
        (make.cylinder(0.2, 2.4, sections=96), (-1.75, 1.2, 4.3), upright, 0.0, "rings"),
        (make.cylinder(0.09, 2.6, sections=64), (0.22, 1.3, 2.75), upright, 0.0, "rings"),
        (make.torus(0.5, 0.17, 64, 32), (-0.2, 0.67, 4.7), 0.0, 0.4 + turns[2], "stone"),
        (make.cone(0.5, 1.4, sections=96), (1.95, 0.0, 4.9), upright, 0.0, "rings"),
        (make.capsule(0.9, 0.3, count=[64, 32]), (-1.15, 0.75, 5.6), upright, 0.0, "spots"),
        (make.icosphere(subdivisions=4, radius=0.3), (0.35, 0.3, 3.35), 0.0, 0.0, "spots"),
        (make.box((1.6, 0.4, 0.8)), (0.2, 0.2, 5.7), 0.0, turns[3], "tiles"),
        (make.icosphere(subdivisions=4, radius=0.45), (0.35, 0.85, 5.7), 0.0, 0.0, "stone"),
        (make.box((0.4, 1.9, 0.4)), (1.7, 0.95, 3.3), 0.0, turns[3], "tiles"),
        (make.cylinder(0.26, 0.45, sections=96), (-1.5, 0.23, 3.0), upright, 0.0, "rings"),
    ]
    parts = []
    for mesh, (x, height, z), about_x, about_y, texture in layout:
        shift = rng.uniform(-0.1, 0.1, size=2)
        frame = euler_matrix(about_x, about_y, 0.0)
        frame[:3, 3] = x + shift[0], FLOOR - height, z + shift[1]
        parts.append((mesh.apply_transform(frame), frame, random_texture(texture, rng)))
    return parts + _leaves(parts[-1][1][:3, 3] - [0.0, 0.2, 0.0], rng)  # the last thing is their pot


def _leaves(root: Array, rng: np.random.Generator) -> list[_Part]:
    """Flat ellipsoids that grow upwards from one point: thin things which hide each other."""
    parts = []
    for turn in rng.uniform(0.0, 6.0) + 2.4 * np.arange(9):
        length = rng.uniform(0.35, 0.6)
        mesh = trimesh.creation.icosphere(subdivisions=3)
        mesh.apply_scale([0.075, length, 0.02]).apply_translation([0.0, -length, 0.0])
        frame = euler_matrix(rng.uniform(0.15, 0.7), turn, 0.0)
        frame[:3, 3] = root
        parts.append((mesh.apply_transform(frame), frame, random_texture("leaf", rng)))
    return parts


def _wall(rng: np.random.Generator) -> _Part:
    """A wavy wall behind the objects, large enough to fill every forward-facing view."""
    x, y = np.meshgrid(np.linspace(-9.0, 9.0, 73), np.linspace(-7.0, FLOOR + 0.1, 34))
    phases = rng.uniform(0.0, 2 * np.pi, size=2)
    z = 6.8 + 0.25 * np.sin(1.3 * x + phases[0]) + 0.2 * np.sin(0.9 * x + 1.7 * y + phases[1])
    return _sheet(x, y, z), np.eye(4), random_texture("wall", rng)


def _floor(x_range: tuple[float, float], z_range: tuple[float, float], rng: np.random.Generator) -> _Part:
    x, z = np.meshgrid(np.linspace(*x_range, 25), np.linspace(*z_range, 25)[::-1])
    return _sheet(x, np.full_like(x, FLOOR), z), np.eye(4), random_texture("floor", rng)


def _sheet(x: Array, y: Array, z: Array) -> trimesh.Trimesh:
    """A grid of points, each coordinate `(rows, columns)`, as a mesh that faces the viewer for whom it is upright."""
    rows, columns = x.shape
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    faces = np.concatenate([first + corners for corners in ([0, columns, 1], [1, columns, columns + 1])])
    return trimesh.Trimesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces, process=False)


def _openness(balls: Array, points: Array, normals: Array, owners: Index) -> Array:
    """How much of the sky the other objects leave free, `(n,)`: a ball at distance d hides cos(angle) (r / d)^2."""
    centers, radii = balls[:, :3], balls[:, 3]
    towards = normals @ centers.T - (normals * points).sum(axis=1, keepdims=True)
    squares = (points**2).sum(axis=1, keepdims=True) - 2.0 * points @ centers.T + (centers**2).sum(axis=1)
    squares = squares.clip(radii**2)
    hidden = towards.clip(0.0) * radii**2 / (squares * np.sqrt(squares))
    hidden[owners[:, None] == np.arange(len(balls))] = 0.0
    return np.asarray((1.0 - 0.8 * hidden).prod(axis=1))
