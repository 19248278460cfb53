"""The room of the synthetic scene: a table with books, a lamp, a plant and a mug before a wall with a picture.

Titles, colours, pictures and leaves derive from the seed, and so do small differences of position: every seed shows the
same kinds of things. The floor is y = 0.
"""

import numpy as np

from . import furniture as make
from .pictures import landscape, outlook, rug, tone
from .textures import Array as Numbers
from .textures import Texture, field
from .world import Instance, World, make_world, put

EYE = np.array([0.0, -0.82, 0.0])  # the middle of the cameras
PATCH = np.array([0.3, 0.12, 0.04])  # half the extent of the training cameras
CENTER = np.array([0.0, -0.6, 1.75])  # what they look at
FOCAL = 0.9  # focal length over the longer side of the image
SUN = np.array([-0.42, -0.62, -0.66])  # unit vectors towards the sun and the middle of the sky
SKY = np.array([0.1, -0.75, -0.65])
WALL = 2.5  # z of the wall
TABLE = 0.42  # height of the table's top
TITLES = ("ATLAS", "BIRDS", "MOON", "TREES", "STARS", "RIVERS", "BREAD", "MUSIC", "CHESS", "SNOW", "OCEAN", "HORSES")
HUES = (0.0, 0.58, 0.11, 0.36, 0.07, 0.76, 0.48, 0.95, 0.63, 0.27, 0.03, 0.54)  # of the books
INKS = ((247, 235, 204), (250, 209, 102))
WHITE = (237, 232, 219)


def make_room(seed: int) -> World:
    """The room of a seed."""
    rng = np.random.default_rng([seed, 2])
    shell = _shell(rng)
    return make_world(shell, _things(rng), SUN, SKY)


def _shell(rng: np.random.Generator) -> list[Instance]:
    """Floor, wall, rug, window and picture: nothing stands behind or under them."""
    boards = make.wood(rng, (158, 107, 66), plank=0.14)
    oak = make.wood(rng, (102, 61, 33))
    skirting = make.Part(make.box((9.0, 0.02, 0.09), (0, -0.01, 0.045)), make.plain(WHITE))
    carpet = make.printed(rug(rng, 1.9, 1.1), 1.9, 1.1, axes=(0, 1))
    window = make.framed(outlook(rng, 0.7, 0.8), 0.7, 0.8, make.plain(WHITE), 0.05) + make.bars(0.7, 0.8, WHITE)
    return [
        *put([make.sheet(9.0, 6.0, boards)], 0.0, 2.0),
        *put([make.sheet(9.0, 6.0, _wallpaper(rng), axis=2)], 0.0, WALL, 1.5),
        *put([skirting], 0.0, WALL),
        *put([make.sheet(1.9, 1.1, carpet)], 0.05, 1.75, 0.01),
        *put(window, -0.62, WALL, 1.15),
        *put(make.framed(landscape(rng, 0.72, 0.5), 0.72, 0.5, oak), 0.42, WALL, 1.13),
    ]


def _things(rng: np.random.Generator) -> list[Instance]:
    """The table with what stands on it, and a ball under it, each a little off the position that is given here."""
    instances = put(make.table(rng, 1.7, 0.62, TABLE), 0.0, 1.75)
    titles = rng.permutation(TITLES)
    covers = [tone(hue, rng.uniform(0.65, 0.8), rng.uniform(0.5, 0.75)) for hue in rng.permutation(HUES)]
    x, z = -0.47, TABLE
    for k in range(9):  # six that stand in a row, and a pile of three
        length = rng.uniform(0.3, 0.36)
        thickness = rng.uniform(0.062, 0.078)
        book = make.book(titles[k], length, 0.22, thickness, covers[k], INKS[k % 2])
        if k < 6:
            instances += put(book, x, 1.78, TABLE + length / 2, upright=True)
            x += thickness + 0.002
        else:
            instances += put(book, 0.22, 1.72, z, rng.uniform(-0.15, 0.15))
            z += thickness
    sectors = [(217, 51, 41), (247, 204, 64), (41, 115, 178), (242, 237, 224)] * 2
    items = [
        (make.mug(tone(rng.choice([0.55, 0.0, 0.45]), 0.65, 0.75)), 0.2, 1.7, z, 0.4),
        (make.lamp((252, 219, 153)), -0.66, 1.8, TABLE, 0.0),
        (make.plant(rng), 0.62, 1.7, TABLE, 3.0),
        (make.ball(0.042, [(204, 31, 26)]), -0.12, 1.53, TABLE, 0.0),
        (make.ball(0.14, sectors), 0.42, 1.6, 0.01, 0.4),
    ]
    for parts, x, y, z, turn in items:
        shift = rng.uniform(-0.025, 0.025, size=2)
        instances += put(parts, x + shift[0], y + shift[1], z, rng.uniform(-turn, turn))
    return instances


def _wallpaper(rng: np.random.Generator) -> Texture:
    """Small diamonds in rows that are shifted by half, on a warm ground."""
    cloud = field(rng, 0.15, 0.8)
    hue = rng.choice([0.09, 0.11, 0.13])
    ground = make.albedo(tone(hue, 0.24, 0.93))
    motif = make.albedo(tone(hue, 0.36, 0.86))

    def texture(points: Numbers) -> Numbers:
        x, z = points[:, 0] / 0.16, points[:, 2] / 0.16
        z = z + 0.5 * (np.floor(x) % 2)
        inside = np.abs(x % 1 - 0.5) + np.abs(z % 1 - 0.5) < 0.2
        return np.asarray(np.where(inside[:, None], motif, ground) * (1 + 0.025 * cloud(points))[:, None])

    return texture
