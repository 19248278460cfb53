"""Which Gaussians still want to be densified, by their distance from the cameras: the paper's own evidence."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kgs.fit.starts.triangulate import camera_centers
from kgs.fit.trainer import Trainer

__all__ = ["count_over_threshold"]

BINS = 6


def count_over_threshold(trainer: Trainer, first_points: Tensor) -> dict[str, Any]:
    """Count Gaussians, and those whose mean gradient is over the densification threshold, by distance.

    The distance is that to the nearest training camera, in medians of the first points' distances; the edges are
    quantiles of these, so that fits that begin alike are counted alike. What lies beyond the outer edges counts in the
    outer bins. Where a fit is at its limit of Gaussians, those count that it could not densify.

    Args:
        trainer: a fit, with what its densifier has seen since the last densification.
        first_points: where it began, `(P, 3)`.

    Returns:
        "distance": edges of the bins; "gaussians" and "over": a count for each bin.
    """
    first, now = _distances(trainer, first_points), _distances(trainer, trainer.model.means.detach())
    edges = torch.quantile(first, torch.linspace(0, 1, BINS + 1, dtype=first.dtype))
    bins = torch.bucketize(now, edges[1:-1])
    over = trainer.densifier.mean_gradients.cpu() >= trainer.densifier.grad_threshold
    return {
        "distance": [round(float(edge / first.median()), 4) for edge in edges],
        "gaussians": torch.bincount(bins, minlength=BINS).tolist(),
        "over": torch.bincount(bins[over], minlength=BINS).tolist(),
    }


def _distances(trainer: Trainer, points: Tensor) -> Tensor:
    centers = camera_centers(trainer.scene.train.cameras)
    return torch.cdist(points.detach().cpu().double(), centers).amin(1)
