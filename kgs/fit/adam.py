"""Adam as :class:`torch.optim.Adam` computes it with `fused=True`, bit for bit, without loading torch's compiler.

Every optimizer of torch imports torch._dynamo when it is made: 1000 modules, 1.5 s.
"""

from collections import defaultdict
from typing import Any

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from kgs._support.errors import ArgumentError
from kgs._support.torch_threads import torch_on_all_threads
from kgs.backends import Backend, get_backend
from kgs.backends.signatures import AdamUpdate

_BETAS = (0.9, 0.999)


class Adam:
    """Adam with a name and a learning rate for each group of one parameter.

    Source: D. Kingma, J. Ba, "Adam: A Method for Stochastic Optimization", ICLR 2015.

    Args:
        groups: dicts with a parameter, `params=[parameter]`, its `name`, and its learning rate `lr`.
        eps: added to the root of the second moment.
        backend: "triton" changes all contiguous parameters in one kernel, with other bits.

    Attributes:
        param_groups: the groups; `lr` may be changed before each step.
        state: for each parameter its `step`, a number, `exp_avg` and `exp_avg_sq`; empty before its first gradient.
    """

    def __init__(self, groups: list[dict[str, Any]], eps: float = 1e-8, backend: str | Backend = "torch") -> None:
        self.param_groups = groups
        self.state: defaultdict[Tensor, Any] = defaultdict(dict)
        self.eps = eps
        parameter = groups[0]["params"][0]
        self._adam_step = get_backend(backend, parameter.device).covering("optimizer", parameter).adam_step

    def step(self) -> None:
        """Change each parameter that has a gradient."""
        by_kernel = list[AdamUpdate]()
        by_torch = list[AdamUpdate]()
        for group in self.param_groups:
            [parameter] = group["params"]
            gradient = parameter.grad
            if gradient is None:
                continue
            state = self.state[parameter]
            if not state:
                state["step"] = 0.0
                state["exp_avg"] = torch.zeros_like(parameter)
                state["exp_avg_sq"] = torch.zeros_like(parameter)
            state["step"] += 1.0
            update = AdamUpdate(parameter, gradient, state["exp_avg"], state["exp_avg_sq"], group["lr"], state["step"])
            covered = self._adam_step is not None and parameter.is_contiguous()
            (by_kernel if covered else by_torch).append(update)
        if by_torch:
            self._step_by_torch(by_torch)
        if self._adam_step is not None and by_kernel:
            self._adam_step(by_kernel, _BETAS, self.eps)
            for update in by_kernel:
                increment_version(update.parameter)

    @torch_on_all_threads()
    @torch.no_grad()
    def _step_by_torch(self, updates: list[AdamUpdate]) -> None:
        beta1, beta2 = _BETAS
        for parameter, gradient, exp_avg, exp_avg_sq, lr, step in updates:
            torch._fused_adam_(
                [parameter],
                [gradient],
                [exp_avg],
                [exp_avg_sq],
                [],
                [_as_tensor(step, parameter)],
                lr=lr,
                beta1=beta1,
                beta2=beta2,
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
        """Step and moments of each parameter by the name of its group, empty before its first gradient."""
        found = {}
        for group in self.param_groups:
            [parameter] = group["params"]
            state = dict(self.state.get(parameter, {}))
            if state:
                state["step"] = _as_tensor(state["step"], parameter)
            found[group["name"]] = state
        return found

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
                expected = f"a step and two moments of shape {tuple(parameter.shape)} for {group['name']}"
                raise ArgumentError("optimizer", f"{expected}, the second not negative", f"shapes {given}")
            moments = {name: torch.empty_like(parameter).copy_(loaded[name]) for name in ("exp_avg", "exp_avg_sq")}
            self.state[parameter] = {"step": float(loaded["step"]), **moments}


def _as_tensor(step: float, parameter: Tensor) -> Tensor:
    """The number of steps as torch's Adam has it, 0-d."""
    return torch.full((), step, dtype=torch.float32, device=parameter.device)
