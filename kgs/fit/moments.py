"""The moments of Adam as plain dicts of tensors, by the name of the parameter group."""

from typing import Any

import torch
from torch import Tensor


def moments_of(optimizer: torch.optim.Optimizer) -> dict[str, dict[str, Tensor]]:
    """Adam's step and moments of each parameter group, by its name; an empty dict if it had no gradient yet."""
    return {group["name"]: optimizer.state.get(group["params"][0], {}) for group in optimizer.param_groups}


def load_moments(optimizer: torch.optim.Optimizer, moments: dict[str, Any]) -> None:
    """The inverse of `moments_of`; a ValueError if shapes or signs are wrong, which torch does not check."""
    groups = optimizer.state_dict()["param_groups"]
    states = {}
    for group, held in zip(groups, optimizer.param_groups, strict=True):
        shape = held["params"][0].shape
        state = moments[group["name"]]
        if state:
            shapes = {"step": (), "exp_avg": shape, "exp_avg_sq": shape}
            negative = any(bool((state[name] < 0).any()) for name in ("step", "exp_avg_sq"))
            if negative or {name: tuple(value.shape) for name, value in state.items()} != shapes:
                raise ValueError(f"optimizer: expected a step and two moments like {group['name']}, got others")
            states[group["params"][0]] = state
    optimizer.load_state_dict({"state": states, "param_groups": groups})
