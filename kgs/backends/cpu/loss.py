"""The photometric loss by the kernels, and the moments of a target."""

import numpy as np
import torch
from torch import Tensor

from kgs._support.compiled.arrays import Array, arrays
from kgs._support.compiled.threads import parallel_for
from kgs._support.memory import array, empty
from kgs._support.torch_threads import thread_count

from .loss_kernels import BAND, RADIUS, fill_moments, ssim_gradient, ssim_maps, total_gradient

PIECES, MIN_PIXELS = 16, 8192  # for the threads; pixels of one


def loss(
    image: Tensor,
    target: Tensor,
    mean: Tensor,
    variance: Tensor,
    taps: list[float],
    dssim_weight: float,
    keep: bool,
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The loss and, with `keep`, its gradient for a gradient of the loss of 1."""
    x, y, mean_y, variance_y = arrays(*(x.flatten(0, 1) for x in (image, target, mean, variance)))
    half = _half(taps)
    threads = thread_count()
    channels, height, width = x.shape
    bands, pieces = _division(x)
    maps = array((3, *x.shape))
    sums = np.zeros((bands, 2))
    parallel_for(threads, bands, ssim_maps, half, x, y, mean_y, variance_y, maps, sums, pieces=pieces)
    absolute, ssim = sums.sum(0) / x.size
    value = image.new_tensor(absolute + dssim_weight * (1.0 - np.minimum(ssim, 1.0)))
    if not keep:
        return value, ()
    image_gradient = torch.empty_like(image, memory_format=torch.contiguous_format)
    padded = array((channels, height + 2 * RADIUS, width))
    bands = channels * -(-padded.shape[1] // BAND)
    parallel_for(threads, bands, ssim_gradient, half, x, y, maps, padded, pieces=pieces)
    by_ssim = np.float32(-dssim_weight / x.size)
    by_l1 = np.float32(1 / x.size)
    out = image_gradient.flatten(0, 1).numpy()
    parallel_for(threads, channels * height, total_gradient, x, y, padded, by_ssim, by_l1, out, pieces=pieces)
    return value, (image_gradient,)


def loss_gradient(kept: tuple[Tensor, ...], taps: list[float], dssim_weight: float, grad: Tensor) -> Tensor:
    """The gradient of the image, which was computed with the loss."""
    (image_gradient,) = kept
    return image_gradient if float(grad) == 1.0 else grad * image_gradient


def local_moments(target: Tensor, taps: list[float]) -> tuple[Tensor, Tensor]:
    """Mean and variance of a target under the window, by the kernels."""
    [y] = arrays(target.flatten(0, 1))
    half = _half(taps)
    mean, variance = (empty((1, *y.shape), target) for _ in range(2))
    bands, pieces = _division(y)
    parallel_for(thread_count(), bands, fill_moments, half, y, mean[0].numpy(), variance[0].numpy(), pieces=pieces)
    return mean, variance


def _half(taps: list[float]) -> tuple[np.float32, ...]:
    """The first taps of the window, up to its middle, as the kernels take them."""
    return tuple(np.float32(tap) for tap in taps[: RADIUS + 1])


def _division(image: Array) -> tuple[int, int]:
    """How many bands of rows all channels have, and into how many pieces they are divided."""
    channels, height, _ = image.shape
    return channels * -(-height // BAND), min(PIECES, -(-image.size // MIN_PIXELS))
