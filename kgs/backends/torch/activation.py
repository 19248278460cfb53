"""The activations in torch: exponential for scales, sigmoid for opacities, and the active bands of harmonics joined."""

import math
from collections.abc import Callable
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
    scales = _or_constant(torch.exp, log_scales, log_scales < math.log(torch.finfo(log_scales.dtype).max), math.inf)
    opacities = _or_constant(torch.sigmoid, opacity_logits, ~opacity_logits.isnan(), math.nan)
    return scales, opacities, colors


def _or_constant(function: Callable[[Tensor], Tensor], x: Tensor, valid: Tensor, constant: float) -> Tensor:
    """A function where its argument is valid, elsewhere a constant: its gradient would be 0 times infinity, or NaN."""
    if x.device.type == "cpu" and not torch.compiler.is_compiling() and bool(valid.all()):
        return function(x)  # on a GPU the answer would be waited for
    return function(x.where(valid, 0.0)).where(valid, constant)


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
