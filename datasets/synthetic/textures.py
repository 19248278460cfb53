"""Procedural solid textures, limited in band so that a camera can resolve them.

A texture is a function of the point alone. Detail comes from sums of cosine waves with random directions and phases
(the spectral form of a stationary Gaussian field); the finest is about 4 pixels of the default synthetic scene.
"""

from collections.abc import Callable
from colorsys import hsv_to_rgb
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Texture = Callable[[Array], Array]
NUM_WAVES = 40
BRICK_TABLE = 64  # the shades of bricks repeat after so many


def random_texture(kind: str, rng: np.random.Generator) -> Texture:
    """Draw a texture: from points `(n, 3)` float32 in the object's own frame, in world units, to colours `(n, 3)`."""
    coarse, fine = field(rng, 0.32, 1.2), field(rng, 0.1, 0.32)
    ramp, other = _ramp(rng), _ramp(rng)
    earthy = rng.uniform(0.0, 0.15)  # a hue between red and yellow
    if kind == "stone":
        return lambda p: ramp(0.6 * coarse(p) + 0.8 * fine(p))
    if kind == "marble":
        return lambda p: ramp(np.sin(9.0 * p[:, 1] + 2.0 * coarse(p)) + 0.8 * fine(p))
    if kind == "rings":
        return lambda p: ramp(np.sin(16.0 * p[:, 2] + 0.7 * coarse(p)) + 0.9 * fine(p))
    if kind == "spots":
        return lambda p: _mix(ramp(coarse(p)), other(coarse(p) + 0.6 * fine(p)), _step(2.0 * fine(p)))
    if kind == "leaf":
        green = _ramp(rng, hue=rng.uniform(0.22, 0.4))
        return lambda p: green(0.5 * np.sin(60.0 * p[:, 0]) + fine(p))
    if kind == "tiles":
        return _bricks(rng, (0.2, 0.2, 0.2), 0.02, lambda p: 0.8 * fine(p))  # cubes
    if kind == "wall":
        return _bricks(rng, (0.62, 0.3, np.inf), 0.035, lambda p: 0.3 * coarse(p) + 0.7 * fine(0.65 * p), earthy)
    if kind == "floor":
        return _bricks(rng, (0.7, np.inf, 0.55), 0.03, lambda p: 0.3 * coarse(p) + 0.8 * fine(p), earthy)
    raise ValueError(f"kind: expected a kind of texture, got {kind!r}")


def field(rng: np.random.Generator, shortest: float, longest: float) -> Texture:
    """A random field of unit variance with wavelengths between the given ones, the longer ones a little stronger."""
    wavelengths = np.exp(rng.uniform(np.log(shortest), np.log(longest), size=NUM_WAVES))
    directions = rng.normal(size=(3, NUM_WAVES))
    waves = (2 * np.pi / wavelengths * directions / np.linalg.norm(directions, axis=0)).astype(np.float32)
    phases = rng.uniform(0.0, 2 * np.pi, size=NUM_WAVES).astype(np.float32)
    amplitudes = wavelengths**0.3
    amplitudes = (amplitudes * np.sqrt(2.0 / (amplitudes**2).sum())).astype(np.float32)
    return lambda points: np.cos(points @ waves + phases) @ amplitudes


def _bricks(
    rng: np.random.Generator, sides: tuple[float, float, float], joint: float, grain: Texture, hue: float | None = None
) -> Texture:
    """Boxes of the given sides, each of its own shade, odd rows shifted by half a side, with joints between them."""
    shades = rng.normal(size=(BRICK_TABLE,) * 3).astype(np.float32)
    ramp, filling, lengths = _ramp(rng, hue), _ramp(rng), np.array(sides, dtype=np.float32)

    def texture(points: Array) -> Array:
        cells = points / lengths + np.float32(0.5)
        cells[:, 0] += 0.5 * (np.floor(cells[:, 1] if np.isinf(sides[2]) else cells[:, 2]) % 2)
        i, j, k = (np.floor(cells).astype(np.int64) % BRICK_TABLE).T
        inside = (0.5 - np.abs(cells % 1.0 - 0.5)) * np.where(np.isinf(lengths), 1.0, lengths)
        mask = _step((inside.min(axis=1) - joint) / np.float32(0.5 * joint))
        texture_grain = grain(points)
        return _mix(filling(texture_grain - 1.0), ramp(0.9 * shades[i, j, k] + texture_grain), mask)

    return texture


def _ramp(rng: np.random.Generator, hue: float | None = None) -> Texture:
    """Colours from dark (below -1) to light (above 1) of about one hue: a Bezier curve through three of them."""
    hues = ((rng.uniform() if hue is None else hue) + rng.uniform(-0.08, 0.08, size=3)) % 1.0
    saturations = rng.uniform([0.2, 0.2, 0.05], [0.7, 0.6, 0.3])
    values = rng.uniform([0.12, 0.5, 0.85], [0.3, 0.7, 1.0])
    colors = (hsv_to_rgb(*hsv) for hsv in zip(hues, saturations, values, strict=True))
    dark, middle, light = (np.array(color, dtype=np.float32) for color in colors)

    def ramp(value: Array) -> Array:
        s = _step(value)[:, None]
        return (1 - s) ** 2 * dark + 2 * s * (1 - s) * middle + s**2 * light

    return ramp


def _step(value: Array) -> Array:
    return 0.5 + 0.5 * np.tanh(value)


def _mix(first: Array, second: Array, mask: Array) -> Array:
    return first + (second - first) * mask[:, None]
