"""Two signs of overfitting in a fitted model: how much its Gaussians rely on each other, and where they would split."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from kgs._support.errors import ArgumentError
from kgs.datasets.scene import Views
from kgs.fit.trainer import Trainer
from kgs.geometry.cameras import to
from kgs.geometry.rigs import camera_centers
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer

BINS = 6


@torch.no_grad()
def coadaptation(
    model: GaussianModel, views: Views, *, near_plane: float = 0.01, subsets: int = 5, seed: int = 0
) -> float | None:
    """How much Gaussians rely on each other: the variance of renders of random halves, 0 where all halves look alike.

    Unbiased, of clamped renders whose opacities are not raised; the mean over channels and over the pixels of all views
    that have an alpha above 0.8 in every one of the `subsets` (at least 2) halves; None where there are no such pixels.
    Source: "Quantifying and Alleviating Co-Adaptation in Sparse-View 3D Gaussian Splatting", arXiv 2508.12720.
    """
    if subsets < 2:
        raise ArgumentError("subsets", "at least 2", subsets)
    renderer = GaussianRenderer(near_plane=near_plane)
    generator = torch.Generator().manual_seed(seed)
    gaussians = model()
    opacities = gaussians.opacities
    total = 0.0
    pixels = 0
    for view in range(len(views)):
        camera = to(views.camera(view), opacities.device)
        renders = []
        for _ in range(subsets):
            half = torch.rand(opacities.shape, generator=generator) < 0.5
            thinned = replace(gaussians, opacities=opacities * half.to(opacities.device))
            renders.append(renderer(thinned, camera, outputs=("image", "alpha")))
        covered = torch.stack([out.alpha[0, 0] > 0.8 for out in renders]).all(0)
        images = torch.stack([out.image[0].clamp(0, 1).double() for out in renders])
        total += float(images.var(0).mean(0)[covered].sum())
        pixels += int(covered.sum())
    return total / pixels if pixels else None


def count_over_threshold(trainer: Trainer, initial_points: Tensor) -> dict[str, Any]:
    """Count Gaussians, and those whose mean gradient is over the threshold of densification, by distance.

    The mean is :attr:`kgs.densify.Densifier.mean_gradients`.

    The distance is that to the nearest training camera, in medians of the initial points' distances. The edges of the
    bins are quantiles of these; what lies beyond counts in the outer bins. Source: the DropGaussian paper.
    """
    centers = camera_centers(trainer.scene.train.cameras.extrinsics)
    initial = torch.cdist(initial_points.detach().cpu().double(), centers).amin(1)
    final = torch.cdist(trainer.model.means.detach().cpu().double(), centers).amin(1)
    edges = torch.quantile(initial, torch.linspace(0, 1, BINS + 1, dtype=initial.dtype))
    bins = torch.bucketize(final, edges[1:-1])
    over = trainer.state.densifier.mean_gradients.cpu() >= trainer.state.densifier.grad_threshold
    return {
        "distance": [round(float(edge / initial.median()), 4) for edge in edges],
        "gaussians": torch.bincount(bins, minlength=BINS).tolist(),
        "over": torch.bincount(bins[over], minlength=BINS).tolist(),
    }
