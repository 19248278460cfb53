"""The garden of the synthetic scene: the room's table on a paved lawn under a sky, to be photographed from all around.

A terrace of slabs lies around the table, grass beyond it; the sky is a dome with hills and clouds, not lit by the sun.
The ground is y = 0. The dome is 9 m away, or so far that the sky does not move with the camera.
"""

import numpy as np
import trimesh
from trimesh.transformations import euler_matrix

from . import furniture as make
from .pictures import tone
from .room import things
from .textures import Array as Numbers
from .textures import Texture, field
from .world import Instance, World, make_world, put

CENTER = np.array([0.0, -0.55, 1.75])  # what the cameras look at
RADIUS = 2.3  # m: of the circle of the cameras
HEIGHT = 0.55  # m: of the middle of that circle above `CENTER`
FOCAL = 0.9  # focal length over the longer side of the image
SUN = np.array([-0.5, -0.75, -0.45])  # towards the sun
SKY = np.array([0.0, -1.0, 0.0])  # towards the middle of the sky
DOME = 9.0  # m: radius of the sky
HORIZON_DISTANCE = 900.0  # m: radius of a sky that is as good as infinitely far away
# Metres from the middle at which the grass has lost half its contrast, under a far sky: less for pixels to alias.
PLAIN = 8.0
TERRACE = 1.55  # m: radius of the terrace
SLAB = 0.42  # m: side of a slab
JOINT = 0.012  # m: half of the gap between two slabs
GRASS, MOSS = (96, 142, 62), (74, 96, 52)
HORIZON = (222, 234, 242)
ZENITH = (86, 146, 214)
CLOUD = (255, 255, 255)
FAR_HILLS = (132, 162, 150)
NEAR_HILLS = (84, 128, 78)


def make_garden(seed: int, far_sky: bool = False) -> World:
    """The garden of a seed, its sky a dome around the lawn, or (`far_sky`) at the horizon."""
    rng = np.random.default_rng([seed, 3])
    radius, fade = (HORIZON_DISTANCE, PLAIN) if far_sky else (DOME, np.inf)
    sky = put([make.Part(_dome(radius), _sky(rng))], CENTER[0], CENTER[2])
    lawn = 2.2 * radius  # its side: it ends behind the sky
    ground = put([make.sheet(lawn, lawn, _ground(rng, fade))], CENTER[0], CENTER[2])
    return make_world(ground, [*things(rng), *_around(rng)], SUN, SKY, unlit=sky)


def _around(rng: np.random.Generator) -> list[Instance]:
    """What stands on the ground around the table: plants and balls, between the table and the cameras' circle."""
    sectors = [tone(hue, 0.75, 0.85) for hue in (0.02, 0.13, 0.58, 0.35)] * 2
    items = [
        (make.plant(rng), 2.1),
        (make.ball(0.16, sectors), 3.7),
        (make.plant(rng), 5.3),
        (make.ball(0.1, [(236, 190, 62), (242, 240, 230)] * 3), 0.6),
    ]
    instances = []
    for parts, angle in items:
        angle += rng.uniform(-0.2, 0.2)
        distance = rng.uniform(1.0, 1.2)
        position = CENTER[0] + distance * np.sin(angle), CENTER[2] - distance * np.cos(angle)
        instances += put(parts, *position, 0.0, rng.uniform(0.0, 3.0))
    return instances


def _dome(radius: float) -> trimesh.Trimesh:
    """The upper half of a ball of few faces, open below the horizon."""
    ball = trimesh.creation.icosahedron().apply_scale(radius)
    ball.apply_transform(euler_matrix(0.3, 0.2, 0.0))
    above = ball.vertices[ball.faces][..., 2].max(axis=1) > 0
    return trimesh.Trimesh(ball.vertices, ball.faces[above], process=False)


def _sky(rng: np.random.Generator) -> Texture:
    """Two ranges of hills at the horizon, paler sky above them, clouds; by the direction from the dome's middle."""
    cloud = field(rng, 0.5, 1.6)
    detail = field(rng, 0.15, 0.5)
    wood = field(rng, 0.06, 0.2)
    phases = rng.uniform(0.0, 2 * np.pi, size=(2, 3))
    horizon, zenith, white, far, near = (
        make.albedo(color) for color in (HORIZON, ZENITH, CLOUD, FAR_HILLS, NEAR_HILLS)
    )

    def ridge(turn: Numbers, base: float, swing: float, shifts: Numbers) -> Numbers:
        waves = [np.sin(k * turn + shift) / k for k, shift in zip((2, 5, 11), shifts, strict=True)]
        return np.asarray(base + swing * sum(waves))

    def texture(points: Numbers) -> Numbers:
        direction = points / np.linalg.norm(points, axis=1, keepdims=True)
        elevation = np.arcsin(direction[:, 2].clip(-1, 1))
        turn = np.arctan2(direction[:, 1], direction[:, 0])
        share = np.sqrt(elevation.clip(0, 1))[:, None]
        colors = horizon * (1 - share) + zenith * share
        cover = 0.5 + 0.5 * np.tanh(2.5 * (cloud(direction) + 0.45 * detail(direction) - 0.35))
        cover = (0.85 * cover * np.tanh(6 * elevation.clip(0, 1)))[:, None]
        colors = colors * (1 - cover) + white * cover
        leaves = (1 + 0.12 * wood(direction))[:, None]
        for base, swing, color, shifts in ((0.13, 0.06, far, phases[0]), (0.06, 0.05, near, phases[1])):
            below = elevation < ridge(turn, base, swing, shifts)
            colors = np.where(below[:, None], color * leaves, colors)
        return np.asarray(colors)

    return texture


def _ground(rng: np.random.Generator, fade: float) -> Texture:
    """Slabs of stone, each of its own shade, with moss between them; grass beyond the terrace, even beyond `fade` m."""
    patch = field(rng, 0.5, 2.0)
    blades = field(rng, 0.05, 0.2)
    grain = field(rng, 0.03, 0.15)
    shades = rng.normal(size=(64, 64))
    tints = rng.normal(size=(64, 64))
    grass = make.albedo(GRASS)
    moss = make.albedo(MOSS)
    stone = make.albedo((178, 170, 158))
    warm = make.albedo((192, 158, 128))

    def texture(points: Numbers) -> Numbers:
        cells = points[:, :2] / SLAB
        cells[:, 0] += 0.5 * (np.floor(cells[:, 1]) % 2)
        column, row = np.floor(cells).astype(np.int64).T % 64
        gap = (0.5 - np.abs(cells % 1 - 0.5)).min(axis=1) * SLAB < JOINT
        tint = (0.5 + 0.35 * tints[column, row]).clip(0, 1)[:, None]
        slabs = (stone * (1 - tint) + warm * tint) * (1 + 0.1 * shades[column, row] + 0.06 * grain(points))[:, None]
        slabs = np.where(gap[:, None], moss * (1 + 0.15 * grain(points))[:, None], slabs)
        distance = np.hypot(points[:, 0], points[:, 1])
        contrast = 1 / (1 + (distance / fade) ** 2)
        lawn = grass * (1 + contrast * (0.14 * patch(points) + 0.16 * blades(points)))[:, None]
        outside = distance > TERRACE + 0.05 * patch(points)
        return np.asarray(np.where(outside[:, None], lawn, slabs))

    return texture
