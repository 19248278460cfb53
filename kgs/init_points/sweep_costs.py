"""Costs of a plane sweep: patches are compared by normalised cross-correlation (NCC), and the costs smoothed.

Source: see `plane_sweep`.
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
MIN_JUMP = 1.5 * STEP
# A plane may lie outside a neighbour's image. Without a score there, chance matches inside beat the true plane.
UNSEEN = 0.3  # the score where no neighbour shows the patch; noise reaches as much
ALONE = 0.6  # the second best score where one neighbour shows it, over that one's
MARGIN = 1e-3  # pixels by which a point may lie outside an image: rounding of the homography
VARIANCE = 1e-5  # added to that of a patch, in squared grey values, so that noise on flat surfaces does not match


def sweep_costs(
    image: Tensor, others: Tensor, homographies: Tensor, backend: str = "auto", memory: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Smoothed costs of each plane and pixel, and the costs before, 1 minus the scores; each `(D, H, W)`.

    Args:
        image: grey, float32 on a CPU, `(H, W)`.
        others: images of the neighbours, `(N, H, W)`.
        homographies: from pixels of `image` to those of a neighbour, by planes, float64, `(N, D, 3, 3)`.
        backend: "numba" and "auto" use kernels if possible.
        memory: float32 `(2, H, W, D)`, for the results of kernels, which is faster than new memory for each view.
    """
    middle = image.mean()  # without it, sums over windows are more exact
    image = image - middle
    others = others - middle
    if takes_kernels(backend, "sweep", image):
        memory = torch.empty(2, *image.shape, homographies.shape[1]) if memory is None else memory
        return _compiled_costs(image, others, homographies, *memory)
    costs = 1.0 - _combine(_scores(image, other, turns) for other, turns in zip(others, homographies, strict=True))
    return _semi_global(costs, image), costs


def _compiled_costs(
    image: Tensor, others: Tensor, homographies: Tensor, smoothed: Tensor, costs: Tensor
) -> tuple[Tensor, Tensor]:
    """`sweep_costs` by the kernels, written to `smoothed` and `costs`, `(H, W, D)`."""
    from .sweep_kernels import HALO, compare, semi_global

    threads = torch.get_num_threads()
    mean, variance = _moments(image)
    moments = mean.numpy(), variance.float().numpy()
    padded = cv2.copyMakeBorder(image.numpy(), HALO, HALO, HALO, HALO, cv2.BORDER_REPLICATE)
    neighbours = torch.nn.functional.pad(others, (0, 1, 0, 1)).numpy()
    constants = tuple(np.float32(constant) for constant in (VARIANCE, UNSEEN, ALONE))
    compare(threads, padded, *moments, constants, neighbours, homographies.numpy(), costs.numpy())
    prices = tuple(np.float32(price) for price in (STEP, JUMP * EDGE, EDGE, MIN_JUMP))
    semi_global(threads, costs.numpy(), image.numpy(), prices, smoothed.numpy())
    return smoothed.permute(2, 0, 1), costs.permute(2, 0, 1)


def _scores(image: Tensor, target: Tensor, homographies: Tensor) -> Tensor:
    """NCC of the patches of each plane and pixel, `(D, H, W)`; -inf where the patch leaves the other image."""
    mean, variance = _moments(image)
    scores = torch.empty(len(homographies), *image.shape)
    for plane, homography in enumerate(homographies):
        warped, inside = warp(target, homography)
        warped_mean, warped_variance = _moments(warped)
        inverse_deviation = ((variance + VARIANCE) * (warped_variance + VARIANCE)).rsqrt()
        score = (_box(image.double() * warped) - mean * warped_mean) * inverse_deviation
        scores[plane] = torch.where(_box(inside.float()) > 0.99, score, -torch.inf)
    return scores


def warp(image: Tensor, homography: Tensor) -> tuple[Tensor, Tensor]:
    """The image at the points to which a homography maps pixels, and whether these lie in the image; both `(H, W)`."""
    height, width = image.shape
    last = torch.tensor([width - 1, height - 1], dtype=torch.float64)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    mapped = torch.stack([columns, rows, torch.ones_like(rows)], -1).double() @ homography.mT
    points = mapped[..., :2] / mapped[..., 2:]
    inside = ((points >= -MARGIN) & (points <= last + MARGIN)).all(-1) & (mapped[..., 2] > 0)
    grid = torch.where(inside[..., None], 2 * points / last - 1, 0.0)
    warped = torch.nn.functional.grid_sample(
        image[None, None].double(), grid[None], padding_mode="border", align_corners=True
    )
    return torch.where(inside, warped[0, 0].float(), 0.0), inside


def _box(image: Tensor) -> Tensor:
    """The mean over the window around each pixel."""
    return torch.from_numpy(cv2.blur(image.numpy(), (WINDOW, WINDOW), borderType=cv2.BORDER_REPLICATE))


def _moments(image: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance over the window around each pixel."""
    image = image.double()  # in float32, rounding would be most of the variance of a flat window
    mean = _box(image)
    return mean, (_box(image * image) - mean * mean).clamp_min(0.0)


def _combine(scores: Iterator[Tensor]) -> Tensor:
    """Three quarters of the best neighbour's score and a quarter of the second best's: others may not see the patch."""
    best = next(scores)
    second = None
    for score in scores:
        lower = torch.minimum(best, score)
        best = torch.maximum(best, score)
        second = lower if second is None else torch.maximum(second, lower)
    if second is not None:
        best = 0.75 * best + 0.25 * torch.where(second > -torch.inf, second, ALONE * best)
    return torch.where(best > -torch.inf, best, UNSEEN)


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
            cheapest_before = previous.amin(0)
            cheapest = torch.minimum(previous, cheapest_before + (JUMP * EDGE / (EDGE + edge)).clamp_min(MIN_JUMP))
            cheapest[1:] = torch.minimum(cheapest[1:], previous[:-1] + STEP)
            cheapest[:-1] = torch.minimum(cheapest[:-1], previous[1:] + STEP)
            more = cheapest - cheapest_before
            if slant:
                more[:, 0 if slant > 0 else -1] = 0.0  # paths begin at the border
            path += more
        total[:, row] += path
        before = path
        last = row
