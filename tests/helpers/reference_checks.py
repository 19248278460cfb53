"""What tests of the reference have in common."""

import torch
from factories import FIELDS, one_gaussian, pinhole
from torch import Tensor

from kgs import Gaussians

EXACT = {"alpha_threshold": 0.0, "transmittance_stop": 0.0}


def tensor(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def fields(gaussians: Gaussians) -> dict[str, Tensor]:
    return {name: getattr(gaussians, name) for name in FIELDS}


def stack(opacities: list[float], colors: list[list[float]], scale: float = 1e6) -> Gaussians:
    """Layers on the optical axis at depths 1, 2, 3, ...; by default so wide that alpha is constant over the image."""
    n = len(opacities)
    means = torch.zeros(n, 3, dtype=torch.float64)
    means[:, 2] = torch.arange(1, n + 1)
    quats = tensor([1, 0, 0, 0]).expand(n, 4)
    return Gaussians(means, quats, torch.full((n, 3), scale).to(means), tensor(*opacities), tensor(*colors))


def one(
    mean: list[float], scale: list[float], opacity: float = 0.8, quat: tuple[float, ...] = (1, 0, 0, 0)
) -> Gaussians:
    return one_gaussian(scale, quat, mean, opacity, (1.0, 0.5, 0.25))


SMALL = pinhole(4, 5, 10)


RED, GREEN, BLUE = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]
