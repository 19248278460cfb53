"""Scenes to measure on: one made of seeded random numbers, and whether those of a folder are there."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera

from kgs.errors import DataError
from kgs.harmonics import SH_C0
from kgs.model import GaussianModel

__all__ = ["SYNTHETIC", "check_scenes", "layered_scene"]

SYNTHETIC = "synthetic"  # the name of the built-in scene in a cell

_DEPTHS = np.array([2.2, 3.0, 4.0, 5.5, 7.5, 9.5])
_SHARES = np.array([0.10, 0.18, 0.22, 0.20, 0.16, 0.14])


def layered_scene(count: int, size: tuple[int, int] = (378, 504), seed: int = 0) -> tuple[GaussianModel, PinholeCamera]:
    """A forward-facing scene such as training ends with: six blurred layers of depth, 15 % wider than the image.

    The footprints' standard deviations have a median of 2.3 pixels whatever the count and the size, so the pairs of
    pixel and Gaussian are proportional to the count; about a quarter of the centres lie beside the image.

    Args:
        count: Gaussians, with harmonics of degree 3.
        size: height and width in pixels.
        seed: of everything.

    Returns:
        The model in float32, and one camera.
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

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.asarray(values, dtype=np.float32))

    model = GaussianModel(
        means=tensor(np.stack([x, y, z], -1)),
        quats=tensor(rng.normal(size=(count, 4))),
        log_scales=tensor(np.log(spread)[:, None] + rng.normal(0, 0.5, (count, 3))),
        opacity_logits=tensor(rng.normal(0, 1.5, count)),
        sh_dc=tensor((np.clip(colors, 0.02, 0.98) - 0.5) / SH_C0)[:, None],
        sh_rest=tensor(rng.normal(0, 0.06, (count, 15, 3))),
    )
    intrinsics = torch.eye(4)[None]
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = focal
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = (width - 1) / 2, (height - 1) / 2
    return model, PinholeCamera(intrinsics, torch.eye(4)[None], torch.tensor([height]), torch.tensor([width]))


def check_scenes(data: Path, scenes: Iterable[str]) -> None:
    """Make sure that the folder of KGS_DATA has these scenes.

    Raises:
        DataError: it lacks one.
    """
    for scene in scenes:
        if not (data / scene).is_dir():
            raise DataError(data, scene, "expected this scene in the folder of KGS_DATA")
