"""Costs of a plane sweep: patches are compared by normalised cross-correlation (NCC), and the costs smoothed.

Source: see `plane_sweep`.
"""

import cv2
import numpy as np
import torch
from torch import Tensor

from kgs._support.torch_threads import torch_on_one_thread
from kgs.backends import Backend

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
PLANES_AT_ONCE = 8  # that torch compares: few, for memory, and enough that a GPU does not wait for their launches
VARIANCE = 1e-5  # added to that of a patch, in squared grey values, so that noise on flat surfaces does not match


def sweep_costs(
    image: Tensor, others: Tensor, homographies: Tensor, backend: Backend, memory: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Smoothed costs of each plane and pixel, and the costs before, 1 minus the scores; each `(D, H, W)`.

    Args:
        image: grey, float32, `(H, W)`.
        others: images of the neighbours, `(N, H, W)`, on its device, as all that follow.
        homographies: from pixels of `image` to those of a neighbour, by planes, float64, `(N, D, 3, 3)`.
        backend: by numba's kernels, on a CPU, or by torch.
        memory: float32 `(2, H, W, D)`, for the results of kernels, which is faster than new memory for each view.
    """
    with torch_on_one_thread():  # else the last bits of a sum depend on the number of threads
        middle = image.mean()  # without it, sums over windows are more exact
    image = image - middle
    others = others - middle
    if backend.covering("sweep", image).name == "numba":
        memory = torch.empty(2, *image.shape, homographies.shape[1]) if memory is None else memory
        return _compiled_costs(image, others, homographies, *memory)
    moments = _moments(image)
    groups = homographies.split(PLANES_AT_ONCE, 1)
    costs = torch.cat([_plane_costs(image, moments, others, planes) for planes in groups])
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
    """1 minus the scores of the pixels on D planes, `(D, H, W)`.

    Three quarters of the best neighbour's score and a quarter of the second best's: others may not see the patch.
    """
    pairs = zip(others, homographies, strict=True)
    scores = torch.stack([_correlations(image, moments, *pair) for pair in pairs]).sort(0, descending=True).values
    best = scores[0]
    if len(scores) > 1:
        best = 0.75 * best + 0.25 * torch.where(scores[1] > -torch.inf, scores[1], ALONE * best)
    return 1.0 - torch.where(best > -torch.inf, best, UNSEEN)


def _correlations(image: Tensor, moments: tuple[Tensor, Tensor], other: Tensor, homographies: Tensor) -> Tensor:
    """NCC of the patch around each pixel, `(D, H, W)`; -inf where the patch leaves the other image."""
    mean, variance = moments
    warped, inside = warp(other, homographies)
    warped_mean, warped_variance = _moments(warped)
    covariance = _box(image.double() * warped) - mean * warped_mean
    scores = covariance * ((variance + VARIANCE) * (warped_variance + VARIANCE)).rsqrt()
    return torch.where(_box(inside.float()) > 0.99, scores, -torch.inf).float()


def warp(image: Tensor, homographies: Tensor) -> tuple[Tensor, Tensor]:
    """The image at the points to which D homographies map pixels, and whether these lie in it; both `(D, H, W)`."""
    height, width = image.shape
    columns = torch.arange(width, dtype=torch.float64, device=image.device).expand(height, width)
    rows = torch.arange(height, dtype=torch.float64, device=image.device)[:, None].expand(height, width)
    pixels = torch.stack([columns, rows, torch.ones_like(rows)], -1).reshape(-1, 3)
    mapped = (pixels @ homographies.mT).reshape(-1, height, width, 3)
    points = mapped[..., :2] / mapped[..., 2:]
    last = pixels[-1, :2]
    inside = ((points >= -MARGIN) & (points <= last + MARGIN)).all(-1) & (mapped[..., 2] > 0)
    grid = torch.where(inside[..., None], 2 * points / last - 1, 0.0)
    source = image.double().expand(len(grid), 1, height, width)
    warped = torch.nn.functional.grid_sample(source, grid, padding_mode="border", align_corners=True)[:, 0]
    return torch.where(inside, warped.float(), 0.0), inside


def _box(images: Tensor) -> Tensor:
    """The mean over the window around each pixel of some images, `(..., H, W)`."""
    flat = images.reshape(-1, *images.shape[-2:])
    if images.device.type == "cpu":
        border = cv2.BORDER_REPLICATE
        means = [torch.from_numpy(cv2.blur(image.numpy(), (WINDOW, WINDOW), borderType=border)) for image in flat]
        return torch.stack(means).reshape(images.shape)
    return _pooled(flat).reshape(images.shape)


def _pooled(images: Tensor) -> Tensor:
    """What OpenCV's blur returns, of images `(B, H, W)`."""
    padded = torch.nn.functional.pad(images[:, None], [WINDOW // 2] * 4, mode="replicate")
    of_columns = torch.nn.functional.avg_pool2d(padded, (WINDOW, 1), stride=1)
    return torch.nn.functional.avg_pool2d(of_columns, (1, WINDOW), stride=1)[:, 0]


def _moments(image: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance over the window around each pixel."""
    image = image.double()  # in float32, rounding would be most of the variance of a flat window
    mean = _box(image)
    return mean, (_box(image * image) - mean * mean).clamp_min(0.0)


def _semi_global(cost: Tensor, grey: Tensor) -> Tensor:
    """The sum of the costs of the cheapest paths along eight directions, `(D, H, W)`."""
    total = torch.zeros_like(cost)
    rows = range(cost.shape[1])
    _add_paths(total, cost, grey, rows, (-1, 0, 1))
    _add_paths(total, cost, grey, rows[::-1], (-1, 0, 1))
    total = total.mT.contiguous()
    cost = cost.mT.contiguous()
    columns = range(cost.shape[1])
    _add_paths(total, cost, grey.mT, columns, (0,))
    _add_paths(total, cost, grey.mT, columns[::-1], (0,))
    return total.mT.contiguous()


def _add_paths(total: Tensor, cost: Tensor, grey: Tensor, rows: range, slants: tuple[int, ...]) -> None:
    """Add the costs of the cheapest paths that go through these rows, `slants` columns to the right per row.

    Args:
        total: where costs are added, `(D, H, W)`.
        cost: of each plane and pixel, `(D, H, W)`.
        grey: the image, `(H, W)`, whose edges make jumps cheaper.
        rows: in the order of the paths, beside each other.
        slants: consecutive numbers, at most 1; paths of all of them go side by side.
    """
    planes, _, width = cost.shape
    # The row before, between columns from which no path comes: of costs 0, as before the first row. Beside the first
    # and last plane there is none to step from.
    before = cost.new_full((len(slants), planes + 2, width + 2), torch.inf)
    before[:, 1:-1] = 0.0
    left, step, column = before.stride()
    shifted = before.as_strided((len(slants), planes + 2, width), (left - 1, step, column), 1 - slants[0])
    beside = torch.nn.functional.pad(grey[None], (1, 1), mode="replicate")[0]
    neighbours = torch.stack([beside[:, 1 - slant : 1 - slant + width] for slant in slants], 1)
    order = torch.tensor(rows, device=grey.device)
    edges = (grey[order, None] - neighbours[order.roll(1)]).abs()
    jumps = (JUMP * EDGE / (EDGE + edges)).clamp_min(MIN_JUMP)
    for row, jump in zip(rows, jumps, strict=True):
        here = shifted[:, 1:-1]
        lowest = here.amin(1, keepdim=True)
        cheapest = torch.minimum(here, lowest + jump[:, None])
        cheapest = torch.minimum(cheapest, torch.minimum(shifted[:, :-2], shifted[:, 2:]) + STEP)
        paths = cheapest.sub_(lowest).add_(cost[:, row])
        before[:, 1:-1, 1:-1] = paths
        for path in paths:
            total[:, row] += path
