"""Estimates, before a fit, how much brighter or warmer each photo is than the others, from the photos alone.

Dense initial points come with the colours of small patches of surface in the views that agree on their depth. If
exposure or white balance changed between photos, all colours of a photo differ from those of the others by a factor in
each channel. The logarithms of the factors, with a mean of zero over the photos, are the least squares solution of

    log color(patch, view) = log color(patch) + log gain(view)

over all patches and views, reweighted against outliers.

A fit with gains shows the scene in the mean exposure. Held-out photos have others, so that their PSNR falls even where
it rises after an affine fit of colours; and shading, reflections and noise give gains, too. Unless they are asked for,
gains are used only where photos differ much, and gains explain it (docs/photos.md).
"""

from dataclasses import replace

import torch
from torch import Tensor

from kgs._support.errors import warn
from kgs.datasets.scene import Scene
from kgs.init_points.patches import MIN_PATCHES, PatchColors

from .decisions import Decisions, ExposureDecision

MIN_RATIO = 1.3  # between the gains of two photos in a channel, for gains to be used
MAX_LEFT = 0.6  # of the median difference of a patch's colours, after the gains, for gains to be used
USABLE = 0.03, 0.97  # colours beyond are black or saturated
ROUNDS = 8  # of the weights
PRIOR = 1e-3  # so many imaginary patches have gain 1: they decide where no real one does


def decide_exposure(patches: PatchColors | None, how: str) -> ExposureDecision | None:
    """The gains of the training photos, if they differ in exposure or white balance.

    Args:
        patches: of the initial points; without any there are no gains, and a warning if they were asked for.
        how: the entry `exposure` of the configuration.
    """
    if how == "same":
        return None
    if patches is None or len(patches) < MIN_PATCHES:
        if how == "each":
            warn("exposure: the initial points come without patches of colour, so photos are taken as equally exposed")
        return None
    gains, left = estimate_gains(patches)
    ratio = float((gains.amax(0) / gains.amin(0)).max())
    if how == "auto" and (ratio < MIN_RATIO or left > MAX_LEFT):
        return None
    rows = [[round(value, 4) for value in row] for row in gains.tolist()]
    return ExposureDecision(gains=rows, left=round(left, 3), n=len(patches))


def estimate_gains(patches: PatchColors) -> tuple[Tensor, float]:
    """The factor of each view's colours, `(V, 3)` float64, and the share of differences that the factors leave.

    In each channel the factors have a geometric mean of 1. Differences are those of a patch's log colours from their
    mean over the views, in the median; the share is that of the channel where it is least, and 1 without patches.

    Iteratively reweighted least squares with the weights of Cauchy; each round is a linear system of V unknowns.
    """
    low, high = USABLE
    colors = patches.colors.double()
    usable = patches.visible & ((colors > low) & (colors < high)).all(2)
    rows = usable.sum(1) >= 2
    usable = usable[rows]
    logs = colors[rows].masked_fill(~usable[..., None], 1.0).log()
    gains = logs.new_zeros(logs.shape[1:])
    if not len(logs):
        return gains.exp(), 1.0
    typical = list[Tensor]()  # differences of each channel
    for _ in range(ROUNDS + 1):
        levels = logs - gains
        means = (levels * usable[..., None]).sum(1, keepdim=True) / usable.sum(1)[:, None, None]
        differences = levels - means
        typical.append(differences[usable].abs().median(0).values.clamp_min(1e-4))
        if len(typical) <= ROUNDS:
            weights = usable[..., None] / (1 + (differences / (2 * typical[-1])).square())
            gains = torch.stack([_solve(weights[..., k], logs[..., k]) for k in range(3)], dim=1)
    return gains.exp(), float((typical[-1] / typical[0]).min())


def _solve(weights: Tensor, logs: Tensor) -> Tensor:
    """Log gains `(V,)` of one channel, with a mean of 0: the patches' own levels are eliminated from the equations."""
    totals = weights.sum(1, keepdim=True)
    count = weights.shape[1]
    own = torch.diag(weights.sum(0) + PRIOR)
    matrix = own - weights.T @ (weights / totals) + 1 / count
    right = (weights * logs).sum(0) - (weights / totals).T @ (weights * logs).sum(1)
    found: Tensor = torch.linalg.solve(matrix, right)
    return found - found.mean()


def before_gain(colors: Tensor, gains: Tensor | None, views: Tensor | None) -> Tensor:
    """The scene's colours, float32, of those `(P, 3)` in photos `views` `(P,)`; as they are if either is None."""
    colors = colors.float()
    return colors if gains is None or views is None else (colors / gains[views]).clamp(0, 1)


def with_exposure(scene: Scene, decisions: Decisions) -> Scene:
    """The scene with the gains of its training views that were decided, if any were.

    Raises:
        ValueError: they are not three numbers above 0 for each view.
    """
    if decisions.exposure is None:
        return scene
    gains = torch.tensor(decisions.exposure.gains, dtype=torch.float32)
    return replace(scene, train=replace(scene.train, gains=gains))
