"""The stages of an optimizer by the kernels."""

import math
from typing import Any

from torch import Tensor

from kgs.backends.signatures import AdamUpdate

from .launch import blocks, launch
from .optimizer_kernels import add_norms, decay_logits, update_by_adam

_BLOCK = 1024  # elements of a program
_TENSORS = 6  # of a launch of `update_by_adam`


def adam_step(updates: list[AdamUpdate], betas: tuple[float, float], eps: float) -> None:
    """A step of Adam, six tensors a launch."""
    beta1, beta2 = betas
    for first in range(0, len(updates), _TENSORS):
        some = updates[first : first + _TENSORS]
        arguments: list[Any] = []
        count = 0
        for parameter, gradient, exp_avg, exp_avg_sq, lr, step in some:
            n = parameter.numel()
            count += blocks(n, _BLOCK)
            step_size = lr / (1.0 - beta1**step)
            root = math.sqrt(1.0 - beta2**step)
            arguments += (parameter, gradient.contiguous(), exp_avg, exp_avg_sq, n, step_size, root)
        arguments += (*arguments[:4], 0, 0.0, 1.0) * (_TENSORS - len(some))  # have no block
        launch(update_by_adam, (count,), *arguments, eps, BETA1=beta1, BETA2=beta2, BLOCK=_BLOCK)


def add_gradient_norms(sums: Tensor, counts: Tensor, ids: Tensor, gradient: Tensor, scale: tuple[float, float]) -> None:
    """Add norms of gradients to statistics, in one launch."""
    m = len(ids)
    launch(
        add_norms, (blocks(m, _BLOCK),), sums, counts, ids.contiguous(), gradient.contiguous(), m, *scale,
        BLOCK=_BLOCK,
    )  # fmt: skip


def decay_opacity(logits: Tensor, factor: float) -> None:
    """Multiply opacities by a factor, in one launch."""
    n = len(logits)
    launch(decay_logits, (blocks(n, _BLOCK),), logits, n, math.log(factor), math.log(1.0 - factor), BLOCK=_BLOCK)
