"""Adam with a learning rate for each parameter of the Gaussians, and its moments by their names."""

from typing import Any

import torch
from torch import Tensor

from kgs.model import GaussianModel

from .config import Recipe

_RATES = {"means": "means", "quats": "quats", "log_scales": "scales", "opacity_logits": "opacity"}
_RATES |= {"sh_dc": "sh_dc", "sh_rest": "sh_rest"}


def adam(model: GaussianModel, recipe: Recipe) -> torch.optim.Adam:
    """The optimiser of a model: one group per parameter, that of the means first."""
    groups = [
        {"params": [model.get_parameter(name)], "lr": getattr(recipe, f"lr_{rate}"), "name": name}
        for name, rate in _RATES.items()
    ]
    return torch.optim.Adam(groups, eps=recipe.adam_eps, fused=True)


def moments_of(optimizer: torch.optim.Optimizer) -> dict[str, dict[str, Tensor]]:
    """Step and moments of each group by its name; an empty dict where it had no gradient yet."""
    return {group["name"]: optimizer.state.get(group["params"][0], {}) for group in optimizer.param_groups}


def load_moments(optimizer: torch.optim.Optimizer, moments: dict[str, Any]) -> None:
    """The inverse of `moments_of`; a ValueError where shapes or signs are wrong, which torch does not check."""
    groups, found = optimizer.state_dict()["param_groups"], {}
    for group, held in zip(groups, optimizer.param_groups, strict=True):
        shape, state = held["params"][0].shape, moments[group["name"]]
        if state:
            shapes = {"step": (), "exp_avg": shape, "exp_avg_sq": shape}
            negative = any(bool((state[name] < 0).any()) for name in ("step", "exp_avg_sq"))
            if negative or {name: tuple(value.shape) for name, value in state.items()} != shapes:
                raise ValueError(f"optimizer: expected a step and two moments like {group['name']}, got others")
            found[group["params"][0]] = state
    optimizer.load_state_dict({"state": found, "param_groups": groups})
