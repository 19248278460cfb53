"""Random fields for procedural solid textures, band-limited so that a camera can resolve them.

A texture is a function of the point alone, to the bit: products of matrices would round the last rows of a block, or a
single row, differently. Detail comes from sums of cosine waves with random directions and phases,
the spectral form of a stationary Gaussian field.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Texture = Callable[[Array], Array]
NUM_WAVES = 40
BLOCK = 256  # points at a time, so that all arrays stay in the cache


def field(rng: np.random.Generator, shortest: float, longest: float) -> Texture:
    """A random field of unit variance with wavelengths between the given ones, the longer ones a little stronger."""
    wavelengths = np.exp(rng.uniform(np.log(shortest), np.log(longest), size=NUM_WAVES))
    directions = rng.normal(size=(3, NUM_WAVES))
    waves = (2 * np.pi / wavelengths * directions / np.linalg.norm(directions, axis=0)).astype(np.float32)
    phases = rng.uniform(0.0, 2 * np.pi, size=NUM_WAVES).astype(np.float32)
    amplitudes = wavelengths**0.3
    amplitudes = (amplitudes * np.sqrt(2.0 / (amplitudes**2).sum())).astype(np.float32)

    def texture(points: Array) -> Array:
        values = np.empty(len(points), dtype=np.float32)
        for start in range(0, len(points), BLOCK):
            rows = slice(start, start + BLOCK)
            x, y, z = points[rows].T[..., None]
            angles = x * waves[0] + y * waves[1] + z * waves[2] + phases
            values[rows] = np.einsum("nk,k->n", np.cos(angles), amplitudes)
        return values

    return texture
