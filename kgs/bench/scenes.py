"""Scenes to measure on, and what they are measured against: the dense reference in float64."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

import kgs.reference
from kgs._support.errors import DataError
from kgs.geometry.cameras import pinhole_cameras, to
from kgs.geometry.harmonics import SH_C0
from kgs.geometry.types import Gaussians
from kgs.model import GaussianModel

SYNTHETIC = "synthetic"  # the name of the built-in scene in a cell
PARAMETERS = ("means", "quats", "scales", "opacities", "colors")
DTYPES = {"float32": torch.float32, "float64": torch.float64}
Scene = tuple[Gaussians, PinholeCamera]
_DEPTHS = np.array([2.2, 3.0, 4.0, 5.5, 7.5, 9.5])  # of the layers
_SHARES = np.array([0.10, 0.18, 0.22, 0.20, 0.16, 0.14])  # of the Gaussians in each


def layered_scene(count: int, size: tuple[int, int] = (378, 504), seed: int = 0) -> tuple[GaussianModel, PinholeCamera]:
    """A forward-facing scene such as training ends with: six blurred layers of depth, 15 % wider than the image.

    Harmonics of degree 3, float32. The footprints' median standard deviation is 2.3 pixels whatever the count and size
    (height, width), so pairs of pixel and Gaussian are proportional to the count; a quarter lie beside the image.
    """
    height, width = size
    rng = np.random.default_rng([seed, count])
    focal = 0.8075 * width
    z = _DEPTHS[rng.choice(6, count, p=_SHARES)] * np.exp(rng.normal(0, 0.06, count))
    x = rng.uniform(-1, 1, count) * 1.15 * width / 2 / focal * z
    y = rng.uniform(-1, 1, count) * 1.15 * height / 2 / focal * z
    z = np.maximum(z + 0.15 * np.sin(3 * x) * np.cos(2 * y), 1.0)
    spread = np.exp(rng.normal(math.log(2.0), 0.6, count)) * z / focal
    colors = 0.5 + 0.35 * np.sin(np.stack([2 * x + z, 1.5 * y - z, x + y], -1)) + rng.normal(0, 0.1, (count, 3))
    values = {
        "means": np.stack([x, y, z], -1),
        "quats": rng.normal(size=(count, 4)),
        "log_scales": np.log(spread)[:, None] + rng.normal(0, 0.5, (count, 3)),
        "opacity_logits": rng.normal(0, 1.5, count),
        "sh_dc": ((np.clip(colors, 0.02, 0.98) - 0.5) / SH_C0)[:, None],
        "sh_rest": rng.normal(0, 0.06, (count, 15, 3)),
    }
    model: Any = {name: torch.from_numpy(value.astype(np.float32)) for name, value in values.items()}
    return GaussianModel(**model), to(centred_camera(size, focal), dtype=torch.float32)


def centred_camera(size: tuple[int, int], focal: float) -> PinholeCamera:
    """At the origin, float64; `size` is height and width."""
    height, width = size
    matrix = [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
    return pinhole_cameras(torch.eye(4).double(), torch.tensor(matrix, dtype=torch.float64), width, height)


def cast(scene: Scene, dtype: torch.dtype) -> Scene:
    """The scene rounded to a dtype; its Gaussians are leaves that want gradients."""
    gaussians, camera = scene
    leaves = {name: getattr(gaussians, name).detach().to(dtype).requires_grad_() for name in PARAMETERS}
    return Gaussians(**leaves), to(camera, dtype=dtype)


def gradients(image: Tensor, gaussians: Gaussians) -> dict[str, Tensor]:
    """Those of a sum of the pixels with random weights, which are the same for all images of one size."""
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(image.shape, generator=generator, dtype=torch.float64).to(image)
    slopes = torch.autograd.grad((image * weights).sum(), [getattr(gaussians, name) for name in PARAMETERS])
    return dict(zip(PARAMETERS, slopes, strict=True))


def exact(scene: Scene, near_plane: float) -> tuple[Tensor, dict[str, Tensor]]:
    """Image and gradients of the dense reference in float64, both thresholds 0."""
    gaussians, camera = cast(scene, torch.float64)
    image = kgs.reference.render(gaussians, camera, None, 0.0, 0.0, near_plane)
    return image.detach(), gradients(image, gaussians)


def relative_errors(got: dict[str, Tensor], expected: dict[str, Tensor]) -> Tensor:
    """The largest error of each parameter's gradient over its largest value, `(5,)` float64; NaN stays."""
    errors = [(got[name] - expected[name]).abs().max() / expected[name].abs().max() for name in PARAMETERS]
    return torch.stack(errors).double()


def check_scenes(data: Path, scenes: Iterable[str]) -> None:
    """DataError where the folder of KGS_DATA lacks one of these scenes."""
    for scene in scenes:
        if not (data / scene).is_dir():
            raise DataError(data, scene, "this scene in the folder of KGS_DATA")
