"""The photometric loss by the kernels: value and gradient are computed together."""

import torch
from torch import Tensor

from .launch import blocks, launch, wide_sum
from .loss_kernels import fold_down, gradient_across, ssim_maps, sum_across

_BLOCK = 256  # pixels of a program


def loss_and_gradient(
    image: Tensor,
    target: Tensor,
    mean: Tensor,
    variance: Tensor,
    taps: list[float],
    dssim_weight: float,
    gradient: bool,
) -> tuple[Tensor, Tensor | None]:
    """See `kgs.backends.Backend`; reads nothing from the device."""
    x, y, mean_y, variance_y = (each.detach().contiguous() for each in (image, target, mean, variance))
    pixels, (height, width) = x.numel(), image.shape[-2:]
    half, count = tuple(taps[:6]), blocks(pixels, _BLOCK)
    across, maps = x.new_empty(3, pixels), x.new_empty(3, pixels)
    sums = x.new_empty(2, count)
    launch(sum_across, (count,), x, y, pixels, width, *half, across, BLOCK=_BLOCK)
    shape = (pixels, height, width)
    launch(ssim_maps, (count,), x, y, mean_y, variance_y, *shape, *half, across, maps, sums, count, BLOCK=_BLOCK)
    absolute, ssim = wide_sum(sums, 1) / pixels
    loss = (absolute + dssim_weight * (1.0 - ssim.clamp_max(1.0))).to(image.dtype)
    if not gradient:
        return loss, None
    down, found = across, torch.empty_like(x)
    launch(fold_down, (count, 3), maps, *shape, *half, down, BLOCK=_BLOCK)
    factors = (-dssim_weight / pixels, 1 / pixels)
    launch(gradient_across, (count,), x, y, pixels, width, *half, down, *factors, found, BLOCK=_BLOCK)
    return loss, found
