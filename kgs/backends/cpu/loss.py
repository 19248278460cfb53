"""The photometric loss by the kernels: value and gradient are computed together."""

import numpy as np
import torch
from torch import Tensor

from kgs.compiled.arrays import arrays
from kgs.compiled.threads import over, thread_count
from kgs.memory import array

from .loss_kernels import BAND, RADIUS, local_moments, ssim_gradient, ssim_maps, total_gradient

PIECES, LEAST = 16, 8192  # for the threads; pixels of one


def loss_and_gradient(
    image: Tensor,
    target: Tensor,
    mean: Tensor | None,
    variance: Tensor | None,
    taps: list[float],
    dssim_weight: float,
    gradient: bool,
) -> tuple[Tensor, Tensor | None]:
    """See `LossStage`."""
    x, y = arrays(image.flatten(0, 1), target.flatten(0, 1))
    half = tuple(np.float32(tap) for tap in taps[: RADIUS + 1])
    threads = thread_count()
    channels, height, width = x.shape
    bands = channels * -(-height // BAND)
    pieces = min(PIECES, -(-x.size // LEAST))
    if mean is None or variance is None:
        mean_y, variance_y = array((2, *x.shape))
        over(threads, bands, local_moments, half, y, mean_y, variance_y, pieces=pieces)
    else:
        mean_y, variance_y = arrays(mean.flatten(0, 1), variance.flatten(0, 1))
    maps = array((3, *x.shape))
    sums = np.zeros((bands, 2))
    over(threads, bands, ssim_maps, half, x, y, mean_y, variance_y, maps, sums, pieces=pieces)
    absolute, ssim = sums.sum(0) / x.size
    loss = image.new_tensor(absolute + dssim_weight * (1.0 - np.minimum(ssim, 1.0)))
    if not gradient:
        return loss, None
    image_gradient = torch.empty_like(image, memory_format=torch.contiguous_format)
    padded = array((channels, height + 2 * RADIUS, width))
    bands = channels * -(-padded.shape[1] // BAND)
    over(threads, bands, ssim_gradient, half, x, y, maps, padded, pieces=pieces)
    by_ssim = np.float32(-dssim_weight / x.size)
    by_l1 = np.float32(1 / x.size)
    out = image_gradient.flatten(0, 1).numpy()
    over(threads, channels * height, total_gradient, x, y, padded, by_ssim, by_l1, out, pieces=pieces)
    return loss, image_gradient
