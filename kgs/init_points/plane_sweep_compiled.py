"""The costs of a plane sweep on `kgs.compiled.sweep`; pictures are warped by OpenCV, as everywhere."""

import numpy as np
import torch
from torch import Tensor

from kgs.compiled.sweep import add_scores, semi_global

from .plane_sweep import EDGE, JUMP, LEAST_JUMP, STEP, VARIANCE, moments, warp

_AT_ONCE = 8  # planes: with 16, rows of scores and of volumes drive each other out of the cache


def compiled_costs(image: Tensor, others: Tensor, homographies: Tensor) -> tuple[Tensor, Tensor]:
    """The stage "sweep"."""
    threads, planes = torch.get_num_threads(), homographies.shape[1]
    best, second = (np.full((*image.shape, planes), -np.inf, np.float32) for _ in range(2))
    grey, mean, variance = (layer.numpy() for layer in (image, *moments(image)))
    for other, turns in zip(others, homographies, strict=True):
        layers = (other, torch.ones_like(other))
        for first, some in enumerate(turns.split(_AT_ONCE)):
            warped = np.stack([[warp(layer, turn).numpy() for layer in layers] for turn in some])
            add_scores(threads, grey, mean, variance, np.float32(VARIANCE), warped, first * _AT_ONCE, best, second)
    if len(others) > 1:
        best *= 0.75
        second *= 0.25
        best += second
    prices = tuple(np.float32(price) for price in (STEP, JUMP * EDGE, EDGE, LEAST_JUMP))
    semi_global(threads, 1.0 - best, grey, prices, second)
    return torch.from_numpy(second).permute(2, 0, 1), torch.from_numpy(best).permute(2, 0, 1)
