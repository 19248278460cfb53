"""The photometric loss on `kgs.compiled.loss`: the value and its gradient are made in one go."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from kgs.compiled.loss import loss_and_gradient

from .photometric import (
    RADIUS,
    WINDOW,
    TargetMoments,
    refuse_second_derivative,
    target_moments,
    torch_loss,
    window_taps,
)


def compiled_loss(
    image: Tensor,
    target: Tensor,
    moments: TargetMoments | None,
    dssim_weight: float,
    outside: Tensor | None,
    fast: bool,
) -> Tensor:
    """The stage "loss"; torch does what has no kernel: masks, L1 alone, small images, second derivatives."""
    if not fast or outside is not None or dssim_weight == 0.0 or min(image.shape[-2:]) < WINDOW:
        return torch_loss(image, target, moments, dssim_weight, outside, fast)
    moments = target_moments(target) if moments is None else moments
    loss: Tensor = _PhotometricLoss.apply(image, target, moments.mean, moments.variance, dssim_weight)
    return loss


class _PhotometricLoss(torch.autograd.Function):
    """The loss of an image and a target given with its moments."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, mean: Tensor, variance: Tensor, weight: float) -> Tensor:
        x, y, mean_y, variance_y = (
            x.detach().contiguous().flatten(0, 1).numpy() for x in (image, target, mean, variance)
        )
        grad = torch.empty_like(image, memory_format=torch.contiguous_format) if ctx.needs_input_grad[0] else None
        out = None if grad is None else grad.flatten(0, 1).numpy()
        taps = tuple(np.float32(tap) for tap in window_taps(image.dtype)[: RADIUS + 1])
        loss = loss_and_gradient(torch.get_num_threads(), taps, x, y, mean_y, variance_y, weight, out)
        ctx.save_for_backward(grad)
        return image.new_tensor(loss)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None, None]:
        refuse_second_derivative()
        return grad * ctx.saved_tensors[0], None, None, None, None
