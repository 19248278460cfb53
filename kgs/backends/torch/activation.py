"""The activations in torch: exponential for scales, sigmoid for opacities, and the active bands of harmonics joined."""

import math
from typing import Any

import torch
from torch import Tensor

from kgs._support.memory import empty
from kgs._support.torch_threads import torch_on_all_threads


def activate(
    log_scales: Tensor, opacity_logits: Tensor, sh_dc: Tensor, sh_rest: Tensor, bands: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Scales, opacities and harmonics, of any dtype that torch differentiates."""
    colors: Tensor = sh_dc
    if bands > 1:
        colors = _JoinedBands.apply(sh_dc, sh_rest, bands)
    # The gradient of exp would be 0 times infinity where it overflows.
    too_large = log_scales >= math.log(torch.finfo(log_scales.dtype).max)
    if log_scales.device.type == "cpu" and not torch.compiler.is_compiling() and not bool(too_large.any()):
        scales = log_scales.exp()
    else:  # on a GPU the answer would be waited for
        scales = log_scales.masked_fill(too_large, 0.0).exp().masked_fill(too_large, math.inf)
    return scales, opacity_logits.sigmoid(), colors


class _JoinedBands(torch.autograd.Function):
    """Concatenate `sh_dc` and the first bands of `sh_rest`, as `torch.cat` does, in buffers that are used again."""

    @staticmethod
    def forward(sh_dc: Tensor, sh_rest: Tensor, bands: int) -> Tensor:
        joined = empty((len(sh_dc), bands, 3), sh_dc)
        with torch_on_all_threads():
            joined[:, :1] = sh_dc
            joined[:, 1:] = sh_rest[:, : bands - 1]
        return joined

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, sh_rest, ctx.bands = inputs
        ctx.rest_shape = sh_rest.shape

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        grad_rest = None
        if ctx.needs_input_grad[1]:
            grad_rest = empty(ctx.rest_shape, grad)
            with torch_on_all_threads():
                grad_rest[:, : ctx.bands - 1] = grad[:, 1:]
                grad_rest[:, ctx.bands - 1 :] = 0.0
        return grad[:, :1], grad_rest, None
