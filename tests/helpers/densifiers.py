"""Densifiers for tests: a model with given scales and opacities, and renders in which it was seen."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from factories import footprints, random_model
from torch import Tensor

from kgs import Densifier, GaussianModel, ProjectedGaussians

SMALL, LARGE = 0.5, 3.0  # scales: cloned up to 1 (0.01 x an extent of 100), split above


def densifier(
    scales: list[float],
    opacities: list[float] | None = None,
    dtype: torch.dtype = torch.float32,
    optimizer: Callable[..., torch.optim.Optimizer] = torch.optim.Adam,
    **options: Any,
) -> tuple[GaussianModel, torch.optim.Optimizer, Densifier]:
    """A model with given (isotropic) scales and opacities, all else random, its optimiser and densifier."""
    model = random_model(len(scales), 2, dtype, seed=7)
    opacity = torch.tensor(opacities or [0.5] * len(scales), dtype=torch.float64)
    with torch.no_grad():
        model.log_scales.copy_(torch.tensor(scales).log()[:, None].expand(-1, 3))
        model.opacity_logits.copy_(opacity.logit())
    groups = [{"params": [parameter], "lr": 0.01, "name": name} for name, parameter in model.named_parameters()]
    made = optimizer(groups, lr=0.01)
    return model, made, Densifier(model, made, **{"extent": 100.0, **options})


def train(model: GaussianModel, optimizer: torch.optim.Optimizer) -> None:
    """One step that gives every parameter of every Gaussian another gradient."""
    optimizer.zero_grad()
    loss = sum((p * torch.arange(1.0, p.numel() + 1).to(p).view_as(p)).sum() for p in model.parameters())
    loss.backward()
    optimizer.step()


def seen(
    model: GaussianModel, ids: list[int], gradients: Any, image_size: tuple[int, int] = (2, 2), **changes: Any
) -> ProjectedGaussians:
    """A render in which the listed Gaussians were seen, with the given gradients in pixels."""
    m, dtype = len(ids), model.means.dtype
    means2d = torch.zeros(m, 2, dtype=dtype, requires_grad=True)
    means2d.grad = torch.tensor(gradients, dtype=dtype).reshape(m, 2)
    changes = {"gaussian_ids": torch.tensor(ids, dtype=torch.int64), "num_gaussians": len(model), **changes}
    return footprints(means2d, torch.zeros(m, 2, 3, dtype=dtype), torch.ones(m, dtype=dtype), image_size, **changes)


def snapshot(model: GaussianModel, optimizer: torch.optim.Optimizer) -> dict[str, tuple[Tensor, dict[str, Tensor]]]:
    """Values and moments of each parameter, copied."""
    return {
        name: (parameter.detach().clone(), {k: v.clone() for k, v in optimizer.state.get(parameter, {}).items()})
        for name, parameter in model.named_parameters()
    }
