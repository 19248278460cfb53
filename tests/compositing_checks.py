"""What tests of compositing have in common."""

import dataclasses

import factories
import pytest
import torch
from factories import random_camera, random_gaussians

from kgs import project

TH, STOP = 1 / 255, 1e-4


DTYPES = [torch.float32, torch.float64]


@pytest.fixture(autouse=True)
def many_bands(monkeypatch):
    """Small pictures in many bands, as large ones are: in each file of tests that imports it."""
    monkeypatch.setattr("kgs.backends.cpu.binning.LEAST", 1)


def drawn(n=300, size=(40, 56)):
    """Projected Gaussians, and what they are projected from."""
    gaussians = random_gaussians(n, 1, torch.float32, None, max(size), (0.05, 1.3))
    camera = random_camera(*size, 1, torch.float32)
    with torch.no_grad():
        return project(gaussians, camera, alpha_threshold=0.0), gaussians, camera


def footprints(opacities, centres=None, factors=None, depths=None, size=(3, 4), dtype=torch.float64, eps2d=0.0):
    """Hand-made projected Gaussians, front to back; without `factors` so wide that alpha is the same everywhere."""
    opacities = torch.as_tensor(opacities, dtype=dtype)
    wide = torch.eye(2, 3, dtype=dtype).mul(1e9).expand(len(opacities), 2, 3)
    factors = wide if factors is None else torch.as_tensor(factors, dtype=dtype)
    centres = torch.zeros(len(opacities), 2) if centres is None else torch.as_tensor(centres, dtype=dtype)
    changes = {} if depths is None else {"depths": torch.as_tensor(depths, dtype=dtype)}
    return factories.footprints(centres.to(dtype), factors, opacities, size, eps2d, **changes)


def leaves(projected, features):
    """The same footprints with leaves for inputs."""
    names = ("means2d", "factors", "opacities")
    inputs = [getattr(projected, name).detach().clone().requires_grad_() for name in names]
    inputs.append(features.detach().clone().requires_grad_())
    return dataclasses.replace(projected, **dict(zip(names, inputs[:3], strict=True))), inputs


def scene_footprints(n, seed, dtype, size=(40, 56), **kwargs):
    """Footprints and colours of an ordinary scene, and two fixed weights for a loss."""
    with torch.no_grad():
        projected = project(
            random_gaussians(n, seed, dtype, **kwargs), random_camera(*size, seed, dtype), alpha_threshold=0.0
        )
    generator = torch.Generator().manual_seed(seed)
    weights = torch.randn(1, 4, *size, generator=generator, dtype=torch.float64).to(dtype)
    return projected, projected.colors, weights
