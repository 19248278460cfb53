"""The dark border that removing a lens's distortion leaves around photos, found from the photos themselves."""

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d

from .scene import Views

WIDEST = 0.02  # of the side, at least `MIN_LINES` pixels
MIN_LINES = 3
DARK = 0.8  # share of the brightness farther inside, below which an edge may be a border
CLEAR = 0.9  # share of the brightness farther inside, from which on a row is no border
FAINTEST = 0.05  # brightness next to a border; where it is darker a border cannot be told from the scene
ALONG = 0.1  # of the side: how far the brightness is averaged along it


def with_border(train: Views) -> Views:
    """The training views with the dark border of their photos, if these are opaque and have one."""
    has_pixels = train.images.device.type != "meta"
    if not has_pixels or train.alphas is not None:
        return train
    return replace(train, border_mask=find_border_mask(train.images))


def find_border_mask(images: Tensor) -> Tensor | None:
    """The share of light that each pixel of these photos lets through, `(H, W)`: below 1 in a dark border.

    A border lies at the same position in all photos, whatever they show, and ends within 2 % of the width or height;
    its thickness may vary along a side. An edge that is dark in only some photos belongs to the scene, and so does a
    dark edge that is wider, or whose surroundings are dark too.

    Args:
        images: at least two photos of one camera, `(V, 3, H, W)` in [0, 1].

    Returns:
        Values in [0, 1], None if there is no border. In reduced photos a border covers some pixels in part.
    """
    if len(images) < 2:
        return None
    bright = images.detach().float().amax(dim=1)
    mask = torch.ones(bright.shape[1:], dtype=torch.float32, device=bright.device)
    for _ in range(4):  # each side is the top once
        bright = torch.rot90(bright, 1, dims=(-2, -1))
        mask = torch.rot90(mask, 1, dims=(-2, -1))
        border = _top_border(bright)
        mask[: len(border)] *= border
    return mask if bool((mask < 1).any()) else None


def _top_border(bright: Tensor) -> Tensor:
    """The border mask `(K, W)` of the first rows of photos `(V, H, W)`; K is 0 without a border there."""
    height, width = bright.shape[1:]
    maximum = max(MIN_LINES, round(WIDEST * height))
    if height <= 2 * maximum:
        return bright.new_zeros(0, width)
    rows = bright.mean(dim=2)
    outer = rows[:, 0]
    inside = rows[:, maximum]
    farther = rows[:, 2 * maximum - 1]
    if bool(((inside < FAINTEST) | (outer > DARK * inside) | (inside < DARK * farther)).any()):  # in any photo
        return bright.new_zeros(0, width)
    half = int(ALONG * width) // 2
    sums = avg_pool1d(bright[:, : 2 * maximum].sum(dim=0), 2 * half + 1, 1, half, count_include_pad=False)
    shares = (sums[:maximum] / sums[maximum:].mean(dim=0).clamp(min=1e-6)).clamp(max=1.0)
    end = int((shares.mean(dim=1) < CLEAR).cumprod(dim=0).sum())
    return torch.where(shares[:end] < CLEAR, shares[:end], 1.0)
