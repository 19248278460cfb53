"""Adam as :class:`torch.optim.Adam` computes it with `fused=True`, bit for bit, without loading torch's compiler.

Every optimizer of torch imports torch._dynamo when it is made: 1000 modules, 1.5 s.
"""

from collections import defaultdict
from typing import Any

import torch
from torch import Tensor

from kgs._support.errors import ArgumentError
from kgs._support.torch_threads import torch_on_all_threads


class Adam:
    """Adam with a name and a learning rate for each group of one parameter.

    Source: D. Kingma, J. Ba, "Adam: A Method for Stochastic Optimization", ICLR 2015.

    Args:
        groups: dicts with a parameter, `params=[parameter]`, its `name`, and its learning rate `lr`.
        eps: added to the root of the second moment.

    Attributes:
        param_groups: the groups; `lr` may be changed before each step.
        state: for each parameter its `step`, `exp_avg` and `exp_avg_sq`; empty before its first gradient.
    """

    def __init__(self, groups: list[dict[str, Any]], eps: float = 1e-8) -> None:
        self.param_groups = groups
        self.state: defaultdict[Tensor, Any] = defaultdict(dict)
        self.eps = eps

    @torch_on_all_threads()
    @torch.no_grad()
    def step(self) -> None:
        """Change each parameter that has a gradient."""
        for group in self.param_groups:
            [parameter] = group["params"]
            if parameter.grad is None:
                continue
            state = self.state[parameter]
            if not state:
                state["step"] = torch.zeros((), dtype=torch.float32, device=parameter.device)
                state["exp_avg"] = torch.zeros_like(parameter)
                state["exp_avg_sq"] = torch.zeros_like(parameter)
            state["step"] += 1
            torch._fused_adam_(
                [parameter],
                [parameter.grad],
                [state["exp_avg"]],
                [state["exp_avg_sq"]],
                [],
                [state["step"]],
                lr=group["lr"],
                beta1=0.9,
                beta2=0.999,
                weight_decay=0.0,
                eps=self.eps,
                amsgrad=False,
                maximize=False,
            )

    def zero_grad(self) -> None:
        """Set all gradients to None."""
        for group in self.param_groups:
            group["params"][0].grad = None

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """Step and moments of each parameter by the name of its group; an empty dict before its first gradient."""
        return {group["name"]: self.state.get(group["params"][0], {}) for group in self.param_groups}

    def load_state_dict(self, state: dict[str, dict[str, Tensor]]) -> None:
        """Continue from a :meth:`state_dict`.

        Raises:
            KeyError: a group is missing.
            ValueError: shapes or signs are wrong.
        """
        for group in self.param_groups:
            [parameter] = group["params"]
            loaded = state[group["name"]]
            if not loaded:
                self.state.pop(parameter, None)
                continue
            shapes = {"step": (), "exp_avg": parameter.shape, "exp_avg_sq": parameter.shape}
            negative = any(bool((loaded[name] < 0).any()) for name in ("step", "exp_avg_sq"))
            if negative or {name: tuple(value.shape) for name, value in loaded.items()} != shapes:
                given = {name: tuple(value.shape) for name, value in loaded.items()}
                raise ArgumentError(
                    f"optimizer: expected a step and two moments of shape {tuple(parameter.shape)} for "
                    f"{group['name']}, the second not negative, got shapes {given}"
                )
            moments = {name: loaded[name].to(parameter, copy=True) for name in ("exp_avg", "exp_avg_sq")}
            self.state[parameter] = {"step": loaded["step"].to(parameter.device, torch.float32, copy=True), **moments}
