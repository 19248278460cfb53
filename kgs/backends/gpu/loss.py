"""The photometric loss by the kernels."""

import torch
from torch import Tensor

from .launch import blocks, has_float64, launch
from .loss_kernels import add_up, fold_down, gradient_across, ssim_maps, sum_across

_BLOCK = 256  # pixels of a program
_SUMS = 2048  # numbers that a single program takes at once


def loss(
    image: Tensor,
    target: Tensor,
    mean: Tensor,
    variance: Tensor,
    taps: list[float],
    dssim_weight: float,
    keep: bool,
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The loss and, with `keep`, the derivatives of the SSIM; reads nothing from the device."""
    x, y, mean_y, variance_y = (each.detach().contiguous() for each in (image, target, mean, variance))
    height, width = image.shape[-2:]
    pixels = x.numel()
    half = taps[:6]
    count = blocks(pixels, _BLOCK)
    across = x.new_empty(3, pixels)
    maps = x.new_empty(3, pixels)
    sums = x.new_empty(2, count)
    value = x.new_empty(())
    launch(sum_across, (count,), x, y, pixels, width, *half, across, BLOCK=_BLOCK)
    inputs = (x, y, mean_y, variance_y, pixels, height, width, *half, across)
    launch(ssim_maps, (count,), *inputs, maps, sums, count, BLOCK=_BLOCK)
    wide = has_float64(x.device)
    launch(add_up, (1,), sums, count, pixels, dssim_weight, value, WIDE=wide, BLOCK=_SUMS, warps=8)
    return value, (x, y, maps) if keep else ()


def loss_gradient(kept: tuple[Tensor, ...], taps: list[float], dssim_weight: float, grad: Tensor) -> Tensor:
    """The gradient of the image, by the kernels."""
    x, y, maps = kept
    height, width = x.shape[-2:]
    pixels = x.numel()
    half = taps[:6]
    count = blocks(pixels, _BLOCK)
    down = torch.empty_like(maps)
    image_gradient = torch.empty_like(x)
    launch(fold_down, (count, 3), maps, pixels, height, width, *half, down, BLOCK=_BLOCK)
    by_ssim = -dssim_weight / pixels
    by_l1 = 1 / pixels
    lines = (pixels, width, *half, down, by_ssim, by_l1, grad)
    launch(gradient_across, (count,), x, y, *lines, image_gradient, BLOCK=_BLOCK)
    return image_gradient
