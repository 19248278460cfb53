"""The dark border that removing a lens's distortion leaves around photos, found from the photos themselves."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d

WIDEST = 0.02  # of the side, at least `FEWEST_LINES` pixels
FEWEST_LINES = 3
DARK, CLEAR = 0.8, 0.9  # shares of the light farther inside: what a border leaves is below, the scene above
SEEN = 0.05  # brightness inside, below which nothing can be told
ALONG = 0.1  # of the side: the part of a line over which the border is taken to be alike


def border_light(images: Tensor) -> Tensor | None:
    """How much of the scene's light each pixel of these photos lets through, `(H, W)`: below 1 in a dark border.

    A border lies at the same place in all photos, whatever they show, and ends within 2 % of the width or height; its
    thickness may vary along a side. What is darker towards an edge in some photos alone is the scene, and so is a dark
    edge that is wider, or whose surroundings are dark too.

    Args:
        images: at least two photos of one camera, `(V, 3, H, W)` in [0, 1].

    Returns:
        Values in [0, 1], None if there is no border. A reduced photo has pixels that the border covers in part.
    """
    if len(images) < 2:
        return None
    bright = images.detach().float().amax(dim=1)
    light = torch.ones(bright.shape[1:], dtype=torch.float32, device=bright.device)
    for _ in range(4):  # each side is the top once
        light, bright = (torch.rot90(each, 1, dims=(-2, -1)) for each in (light, bright))
        side = _from_top(bright)
        light[: len(side)] *= side
    return light if bool((light < 1).any()) else None


def _from_top(bright: Tensor) -> Tensor:
    """The light of the first rows of photos `(V, H, W)`, `(K, W)`; K is 0 without a border there."""
    height, width = bright.shape[1:]
    most = max(FEWEST_LINES, round(WIDEST * height))
    if height <= 2 * most:
        return bright.new_zeros(0, width)
    rows = bright.mean(dim=2)
    outer, inside, farther = rows[:, 0], rows[:, most], rows[:, 2 * most - 1]
    if bool(((inside < SEEN) | (outer > DARK * inside) | (inside < DARK * farther)).any()):  # in any photo
        return bright.new_zeros(0, width)
    half = int(ALONG * width) // 2
    sums = avg_pool1d(bright[:, : 2 * most].sum(dim=0), 2 * half + 1, 1, half, count_include_pad=False)
    shares = (sums[:most] / sums[most:].mean(dim=0).clamp(min=1e-6)).clamp(max=1.0)
    end = int((shares.mean(dim=1) < CLEAR).cumprod(dim=0).sum())
    return torch.where(shares[:end] < CLEAR, shares[:end], 1.0)
