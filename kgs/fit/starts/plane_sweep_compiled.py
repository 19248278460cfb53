"""The costs of a plane sweep on `kgs.compiled.sweep`; pictures are warped by OpenCV, as everywhere."""

import numpy as np
import torch
from torch import Tensor

from kgs.compiled.sweep import add_scores, semi_global

from .plane_sweep import EDGE, JUMP, LEAST_JUMP, STEP, VARIANCE, moments, warp

_AT_ONCE = 16  # planes


def compiled_costs(image: Tensor, others: Tensor, homographies: Tensor) -> tuple[Tensor, Tensor]:
    """The stage "sweep"."""
    threads, planes = torch.get_num_threads(), homographies.shape[1]
    best, second = (np.full((*image.shape, planes), -np.inf, np.float32) for _ in range(2))
    grey, mean, variance = (layer.numpy() for layer in (image, *moments(image)))
    for other, turns in zip(others, homographies, strict=True):
        layers = (other, torch.ones_like(other))
        for first, some in enumerate(turns.split(_AT_ONCE)):
            warped = torch.stack([warp(layer, turn) for turn in some for layer in layers]).unflatten(0, (-1, 2)).numpy()
            add_scores(threads, grey, mean, variance, np.float32(VARIANCE), warped, first * _AT_ONCE, best, second)
    if len(others) > 1:
        best *= 0.75
        second *= 0.25
        best += second
    del second
    prices = tuple(np.float32(price) for price in (STEP, JUMP * EDGE, EDGE, LEAST_JUMP))
    costs = semi_global(threads, 1.0 - best, grey, prices)
    return torch.from_numpy(costs).permute(2, 0, 1), torch.from_numpy(best).permute(2, 0, 1)
