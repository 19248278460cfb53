"""The stiff and extreme cases that the renderer is held to, each with what is stiff, its treatment and its bounds.

A case is a scene in float64 that is rounded once to the dtype under test; the dense reference then gets the very same
numbers in float64, so that an error is the renderer's own. Bounds are absolute for the image and relative to the
largest value for gradients. Sources: the numbers of the cases are those of the literature's bug reports and of error
analysis in float32 (five times what the chosen formula reaches).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.types import Gaussians

__all__ = ["CASES", "Case", "ordinary"]

Scene = tuple[Gaussians, PinholeCamera]
SIZE, FOCAL = (48, 48), 60.0
COUNT = 200
SHAPE = torch.tensor([1.0, 0.6, 0.3], dtype=torch.float64)  # of Gaussians that are not round: round ones cannot turn
# Forward and gradient, in float32 and float64: what an ordinary scene reaches, times five.
ORDINARY = {"float32": (7e-6, 1e-5), "float64": (1e-13, 1e-12)}


@dataclass(frozen=True)
class Case:
    """One row of the table.

    Args:
        name: what it is.
        stiff: what makes it hard.
        treatment: what the renderer does about it.
        scene: makes the Gaussians and the camera, float64.
        bounds: by dtype, of image and gradients.
        options: of the renderer and of the reference alike: near_plane, eps2d.
    """

    name: str
    stiff: str
    treatment: str
    scene: Callable[[], Scene]
    bounds: dict[str, tuple[float, float]] = field(default_factory=lambda: ORDINARY)
    options: dict[str, Any] = field(default_factory=dict)


def camera(
    size: tuple[int, int] = SIZE, focal: float = FOCAL, centre: tuple[float, float] | None = None
) -> PinholeCamera:
    """At the origin; `centre` is the principal point, by default the image's."""
    height, width = size
    matrix = torch.diag(torch.tensor([focal, focal, 1.0, 1.0], dtype=torch.float64))
    matrix[:2, 2] = torch.tensor(centre or ((width - 1) / 2, (height - 1) / 2), dtype=torch.float64)
    return PinholeCamera(matrix[None], torch.eye(4).double()[None], torch.tensor([height]), torch.tensor([width]))


def gaussians(count: int = COUNT, seed: int = 0, **changes: Tensor | float) -> Gaussians:
    """An ordinary cloud before `camera`: two to six units deep, one to five pixels wide, harmonics of degree 1."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    depth = uniform(2.0, 6.0, count)
    place = uniform(-1.1, 1.1, count, 2) * (SIZE[1] / 2 / FOCAL)
    values: dict[str, Tensor] = {
        "means": torch.cat([place * depth[:, None], depth[:, None]], 1),
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "scales": uniform(1.0, 5.0, count, 3) * depth[:, None] / FOCAL,
        "opacities": uniform(0.05, 0.9, count),
        "colors": 0.5 * torch.randn(count, 4, 3, generator=generator, dtype=torch.float64),
    }
    for name, value in changes.items():
        values[name] = torch.as_tensor(value, dtype=torch.float64).expand_as(values[name]).clone()
    return Gaussians(**values)


def ordinary(count: int = COUNT, size: tuple[int, int] = SIZE) -> Scene:
    """What a case's time is compared with."""
    return gaussians(count), camera(size)


def _uniform(low: float, high: float, *shape: int) -> Tensor:
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def _at_the_near_plane() -> Scene:
    """Three world units wide in the picture's plane are thousands of pixels here."""
    depth = 0.01 * (1 + torch.logspace(-6, 1, COUNT, dtype=torch.float64))
    place = _uniform(-0.4, 0.4, COUNT, 2) * depth[:, None]
    return gaussians(means=torch.cat([place, depth[:, None]], 1), scales=0.05 * SHAPE), camera()


def _off_axis() -> Scene:
    cloud = gaussians()
    tangent = _uniform(0.8, 5.0, COUNT)
    angle = _uniform(0, 2 * math.pi, COUNT)
    depth = cloud.means[:, 2]
    place = torch.stack([tangent * angle.cos(), tangent * angle.sin()], 1) * depth[:, None]
    return gaussians(means=torch.cat([place, depth[:, None]], 1), scales=_uniform(0.1, 3.0, COUNT, 3)), camera()


def _stretched(ratio: float, pancake: bool) -> Scene:
    """The small axes are a fiftieth of a pixel: what is seen of them is the dilation."""
    small = 0.02 / FOCAL * gaussians().means[:, 2:]
    scales = torch.cat([small * ratio, small * ratio if pancake else small, small], 1)
    return gaussians(scales=scales, opacities=0.3), camera()


def _scales_of_any_size() -> Scene:
    sizes = torch.tensor(list(itertools.product((0.0, 1e-45, 1e-30, 1e-6, 1.0, 1e3), repeat=3)), dtype=torch.float64)
    return gaussians(len(sizes), scales=sizes, opacities=_uniform(0.02, 0.1, len(sizes))), camera()


def _layers(count: int, opacity: Tensor | float, size: tuple[int, int]) -> Scene:
    """Wider than the picture, one behind the other."""
    depth = torch.linspace(2.0, 6.0, count, dtype=torch.float64)
    means = torch.stack([torch.zeros_like(depth), torch.zeros_like(depth), depth], 1)
    scales = 2.0 * depth[:, None] * SHAPE
    return gaussians(count, means=means, scales=scales, opacities=opacity), camera(size)


def _ties() -> Scene:
    cloud = gaussians()
    means = cloud.means.clone()
    means[:, 2] = 4.0
    return gaussians(means=means), camera()


def _quaternions() -> Scene:
    norms = torch.logspace(-30, 30, COUNT, dtype=torch.float64)
    quats = gaussians().quats * norms[:, None]
    quats[::20] = 0.0
    return gaussians(quats=quats), camera()


def _beside_the_camera() -> Scene:
    """The direction of the colour turns by radians within a pixel's reach, and meets all poles."""
    axes = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 1e-3], [0.0, 1.0, 1e-3], [1e-20, 0.0, 1.0]], dtype=torch.float64)
    means = (axes.repeat(COUNT // 4, 1) * _uniform(0.0101, 0.05, COUNT, 1)).clamp_min(-1)
    means[:, 2] = means[:, 2].clamp_min(0.0101)
    colors = torch.randn(COUNT, 16, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    cloud = gaussians(means=means, scales=1e-3 * SHAPE, opacities=_uniform(0.05, 0.3, COUNT))
    return Gaussians(cloud.means, cloud.quats, cloud.scales, cloud.opacities, 0.3 * colors), camera()


def _in_units(unit: float) -> Scene:
    cloud = gaussians()
    return gaussians(means=cloud.means * unit, scales=cloud.scales * unit), camera()


def _far_from_the_origin(distance: float) -> Scene:
    """Scene and camera moved together, in float64."""
    cloud, pose = gaussians(), torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -distance * torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64)
    view = camera()
    return gaussians(means=cloud.means - pose[:3, 3]), PinholeCamera(
        view.intrinsics, pose[None], view.height, view.width
    )


def _bounds(float32: tuple[float, float], float64: tuple[float, float] = ORDINARY["float64"]) -> Any:
    return {"float32": float32, "float64": float64}


CASES = [
    Case("ordinary", "nothing", "", ordinary),
    Case(
        "at the near plane",
        "1/z: footprints of 10 to 300 000 pixels",
        "nothing is divided before it has passed z > near",
        _at_the_near_plane,
    ),
    Case(
        "far off axis",
        "tangents up to 5: the linear footprint grows without bound",
        "the linearisation is taken at most 15 % beyond the image's border, and its gradient follows that exactly",
        _off_axis,
    ),
    *(
        Case(
            f"{'pancakes' if pancake else 'needles'}, {ratio:.0e} : 1",
            "a c - b^2 of the covariance cancels",
            "the 2x3 factor is kept, its determinant is a sum of squares; exponent by LDL^T with the larger pivot",
            partial(_stretched, ratio, pancake),
            _bounds(float32, float64),
        )
        for pancake, ratio, float32, float64 in (
            (False, 1e3, (2e-5, 6e-4), (1e-12, 1e-11)),
            (False, 1e5, (1.5e-3, 1.4e-3), (1e-9, 1e-8)),  # in float64 the oracle's own error: against 50 digits kgs
            (False, 1e6, (8e-3, 1.4e-3), (1e-7, 2e-6)),  # has 2e-15 in both
            (True, 1e6, (4e-4, 1e-3), ORDINARY["float64"]),
        )
    ),
    Case(
        "scales 0 to 1000",
        "dots, lines and discs, and all at once",
        "as above; 0 is a legal scale",
        _scales_of_any_size,
        _bounds((2e-3, 1e-2), (1e-8, 1e-6)),  # in float64 the oracle's own error
    ),
    Case(
        "a hundredth of a pixel",
        "smaller than the grid",
        "the dilation of 0.3 px^2",
        lambda: (gaussians(scales=0.01 / 20 * SHAPE), camera()),
    ),
    Case(
        "a thousand pixels",
        "every Gaussian in every tile",
        "lists are counted before they are made",
        lambda: (gaussians(scales=60.0 * SHAPE, opacities=0.05), camera()),
    ),
    Case(
        "opacities 1e-30, 1 and 1.25",
        "logarithms; alpha at its maximum, where its derivative jumps",
        "alpha is held at 0.99 for each pixel, with derivative 0 there",
        lambda: (gaussians(opacities=torch.tensor([1e-30, 1.0, 1.25, 0.5] * (COUNT // 4))), camera()),
        _bounds((7e-6, 5e-5)),  # the exponent holds ln o: |ln o| times the rounding of float32, relative
    ),
    Case(
        "20 000 faint layers",
        "the light falls to 1e-34: products underflow, sums grow long",
        "light is multiplied, the colour behind is carried as a mean; nothing is divided by 1 - alpha",
        partial(_layers, 20_000, 1 / 255, (8, 8)),
        _bounds((1e-5, 1e-4)),
    ),
    Case(
        "opaque wall",
        "1 / (1 - alpha) would be 100",
        "as above",
        partial(_layers, COUNT, 0.999, SIZE),
    ),
    Case("one depth for all", "ties in the order", "a stable sort: ties keep their index", _ties),
    Case(
        "quaternions of norm 0 to 1e30",
        "squares under- and overflow; 0 has no direction",
        "divided by the largest entry first; 0 turns nothing and gets no gradient",
        _quaternions,
    ),
    Case(
        "beside the camera",
        "directions of the harmonics of degree 3 at the poles, a millimetre from the centre",
        "polynomials in the unit vector, which is only made behind the near plane",
        _beside_the_camera,
    ),
    *(
        Case(
            f"world unit {unit:.0e}",
            "absolute constants",
            "there are none in world units but the near plane, which fits take from the scene",
            partial(_in_units, unit),
            options={"near_plane": 0.01 * unit},
        )
        for unit in (1e-6, 1e6)
    ),
    Case(
        "5000 units from the origin",
        "float32 coordinates are rounded to 2e-4",
        "loaders recentre in float64; what comes from elsewhere is drawn as it was rounded",
        partial(_far_from_the_origin, 5e3),
        _bounds((4e-3, 6e-3), (5e-12, 1e-11)),
    ),
    *(
        Case(
            f"image of {width} x {height}",
            "fewer pixels than a tile, or one row of many",
            "the last tiles are cut",
            partial(ordinary, COUNT, (height, width)),
            bounds,
        )
        for height, width, bounds in (
            (1, 1, ORDINARY),
            (17, 15, ORDINARY),
            (1, 4097, _bounds((5e-5, 1e-4))),  # coordinates of 2048 pixels are rounded to 1.2e-4
        )
    ),
]
