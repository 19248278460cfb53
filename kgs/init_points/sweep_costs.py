"""Costs of a plane sweep: patches are compared by normalised cross-correlation (NCC), and the costs smoothed.

Source: see `plane_sweep`.
"""

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
# Quarter turns that lead each direction of the smoothing down, and its columns per row, in the order of the kernels
DIRECTIONS = ((1, 1), (0, 0), (0, 1), (2, 1), (2, 0), (3, 1), (3, 0), (1, 0))
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
    moments = _moments(image)
    costs = torch.stack([_plane_costs(image, moments, others, plane) for plane in homographies.unbind(1)])
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


def _plane_costs(image: Tensor, moments: tuple[Tensor, Tensor], others: Tensor, homographies: Tensor) -> Tensor:
    """1 minus the scores of the pixels on one plane, `(H, W)`.

    Three quarters of the best neighbour's score and a quarter of the second best's: others may not see the patch.
    """
    pairs = zip(others, homographies, strict=True)
    scores = torch.stack([_correlations(image, moments, *pair) for pair in pairs]).sort(0, descending=True).values
    best = scores[0]
    if len(scores) > 1:
        best = 0.75 * best + 0.25 * torch.where(scores[1] > -torch.inf, scores[1], ALONE * best)
    return 1.0 - torch.where(best > -torch.inf, best, UNSEEN)


def _correlations(image: Tensor, moments: tuple[Tensor, Tensor], other: Tensor, homography: Tensor) -> Tensor:
    """NCC of the patch around each pixel, `(H, W)`; -inf where the patch leaves the other image."""
    mean, variance = moments
    warped, inside = warp(other, homography)
    warped_mean, warped_variance = _moments(warped)
    covariance = _box(image.double() * warped) - mean * warped_mean
    scores = covariance * ((variance + VARIANCE) * (warped_variance + VARIANCE)).rsqrt()
    return torch.where(_box(inside.float()) > 0.99, scores, -torch.inf).float()


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


def _semi_global(cost: Tensor, grey: Tensor) -> Tensor:
    """The sum of the costs of the cheapest paths along eight directions, `(D, H, W)`."""
    total = torch.zeros_like(cost)
    for turns, slant in DIRECTIONS:
        total += _path_costs(cost.rot90(turns, (1, 2)), grey.rot90(turns), slant).rot90(-turns, (1, 2))
    return total


def _path_costs(cost: Tensor, grey: Tensor, slant: int) -> Tensor:
    """Costs of the cheapest paths that come down row by row, `slant` columns to the right per row, `(D, H, W)`."""
    paths = cost.clone()
    end = cost.shape[2] - slant
    for row in range(1, cost.shape[1]):  # of the first row, and at the side, paths begin
        before = paths[:, row - 1, :end]
        lowest = before.amin(0)
        edge = (grey[row, slant:] - grey[row - 1, :end]).abs()
        cheapest = torch.minimum(before, lowest + (JUMP * EDGE / (EDGE + edge)).clamp_min(MIN_JUMP))
        cheapest[1:] = torch.minimum(cheapest[1:], before[:-1] + STEP)
        cheapest[:-1] = torch.minimum(cheapest[:-1], before[1:] + STEP)
        paths[:, row, slant:] += cheapest - lowest
    return paths
