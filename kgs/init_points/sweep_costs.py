"""Costs of a plane sweep: patches are compared by normalised cross-correlation (NCC), and the costs smoothed.

Source: see `plane_sweep`. Images are warped by OpenCV, whatever the backend.
"""

from collections.abc import Iterator

import cv2
import numpy as np
import torch
from torch import Tensor

from kgs.backends import takes_kernels

WINDOW = 7  # pixels, the side of the patches that are compared
# Prices of the smoothing, in units of 1 - NCC: of a step by one plane, and of a jump where the image has no edge.
STEP = 0.1
JUMP = 2.0
EDGE = 0.02  # the difference of grey values that halves the price of a jump
LEAST_JUMP = 1.5 * STEP
VARIANCE = 1e-5  # added to that of a patch, in squared grey values, so that noise on flat surfaces does not match
_AT_ONCE = 8  # planes in a call of kernels; with 16, rows of scores and of volumes no longer fit into the cache


def sweep_costs(image: Tensor, others: Tensor, homographies: Tensor, backend: str = "auto") -> tuple[Tensor, Tensor]:
    """Smoothed costs and scores of each plane and pixel, each `(D, H, W)`.

    Args:
        image: grey, float32 on a CPU, `(H, W)`.
        others: images of the neighbours, `(N, H, W)`.
        homographies: from pixels of `image` to those of a neighbour, by planes, float64, `(N, D, 3, 3)`.
        backend: "numba" and "auto" use kernels if possible.
    """
    if takes_kernels(backend, "sweep", image):
        return _compiled_costs(image, others, homographies)
    scores = _combine(_scores(image, other, turns) for other, turns in zip(others, homographies, strict=True))
    return _semi_global(1.0 - scores, image), scores


def _compiled_costs(image: Tensor, others: Tensor, homographies: Tensor) -> tuple[Tensor, Tensor]:
    """`sweep_costs` by the kernels."""
    from .sweep_kernels import add_scores, semi_global

    threads = torch.get_num_threads()
    planes = homographies.shape[1]
    best = np.full((*image.shape, planes), -np.inf, np.float32)
    second = np.full_like(best, -np.inf)
    grey = image.numpy()
    mean, variance = (moment.numpy() for moment in _moments(image))
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


def _scores(image: Tensor, target: Tensor, homographies: Tensor) -> Tensor:
    """NCC of the patches of each plane and pixel, `(D, H, W)`; 0 where the patch leaves the other image."""
    mean, variance = _moments(image)
    scores = torch.empty(len(homographies), *image.shape)
    for plane, homography in enumerate(homographies):
        warped = warp(target, homography)
        inside = warp(torch.ones_like(target), homography)
        warped_mean, warped_variance = _moments(warped)
        inverse_deviation = ((variance + VARIANCE) * (warped_variance + VARIANCE)).rsqrt()
        score = (_box(image * warped) - mean * warped_mean) * inverse_deviation
        scores[plane] = torch.where(_box(inside) > 0.99, score, 0.0)
    return scores


def warp(image: Tensor, homography: Tensor) -> Tensor:
    """The image at the places to which a homography maps pixels, `(H, W)`; 0 outside and behind the camera."""
    height, width = image.shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = torch.from_numpy(cv2.warpPerspective(image.numpy(), homography.numpy(), (width, height), flags=flags))
    x, y, one = homography[2]
    if min(x * (width - 1), 0) + min(y * (height - 1), 0) + one > 0:
        return warped
    return torch.where(x * torch.arange(width) + (y * torch.arange(height))[:, None] + one > 0, warped, 0.0)


def _box(image: Tensor) -> Tensor:
    """The mean over the window around each pixel."""
    return torch.from_numpy(cv2.blur(image.numpy(), (WINDOW, WINDOW), borderType=cv2.BORDER_REPLICATE))


def _moments(image: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance over the window around each pixel."""
    mean = _box(image)
    return mean, (_box(image * image) - mean * mean).clamp_min(0.0)


def _combine(scores: Iterator[Tensor]) -> Tensor:
    """Three quarters of the best neighbour's score and a quarter of the second best's: others may not see the place."""
    best = next(scores)
    second = None
    for score in scores:
        lower = torch.minimum(best, score)
        best = torch.maximum(best, score)
        second = lower if second is None else torch.maximum(second, lower)
    return best if second is None else 0.75 * best + 0.25 * second


def _semi_global(cost: Tensor, grey: Tensor) -> Tensor:
    """The sum of the costs of the cheapest paths along eight directions, `(D, H, W)`."""
    total = torch.zeros_like(cost)
    for volume, image, result in ((cost, grey, total), (cost.mT, grey.mT, total.mT)):
        for flip in (False, True):
            for slant in (-1, 0, 1) if volume is cost else (0,):  # diagonals once
                _add_paths(volume, image, result, flip, slant)
    return total


def _add_paths(cost: Tensor, grey: Tensor, total: Tensor, flip: bool, slant: int) -> None:
    """Add the costs of the cheapest paths that come down row by row, `slant` columns to the right per row."""
    rows = range(cost.shape[1])
    before = torch.empty(0)
    last = -1
    for row in reversed(rows) if flip else rows:
        path = cost[:, row].clone()
        if last >= 0:
            previous = before.roll(slant, 1)
            edge = (grey[row] - grey[last].roll(slant)).abs()
            least = previous.amin(0)
            cheapest = torch.minimum(previous, least + (JUMP * EDGE / (EDGE + edge)).clamp_min(LEAST_JUMP))
            cheapest[1:] = torch.minimum(cheapest[1:], previous[:-1] + STEP)
            cheapest[:-1] = torch.minimum(cheapest[:-1], previous[1:] + STEP)
            more = cheapest - least
            if slant:
                more[:, 0 if slant > 0 else -1] = 0.0  # paths begin at the border
            path += more
        total[:, row] += path
        before = path
        last = row
