"""How much Gaussians rely on each other: the spread of renders that lack a random half of them.

Source: "Quantifying and Alleviating Co-Adaptation in Sparse-View 3D Gaussian Splatting" (NeurIPS 2025, arXiv
2508.12720): the variance of the renders of random subsets, over pixels that the subsets cover.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from kgs.datasets.scene import Views
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer

__all__ = ["coadaptation"]

COVERED = 0.8  # alpha from which a pixel counts, in every subset


class _RandomHalf(nn.Module):
    """Switches half of the Gaussians off, in `eval()` too, and leaves the others as they are."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.generator = torch.Generator().manual_seed(seed)

    def forward(self, opacities: Tensor) -> Tensor:
        kept = torch.rand(opacities.shape, generator=self.generator) < 0.5
        return opacities * kept.to(opacities)


@torch.no_grad()
def coadaptation(
    model: GaussianModel, views: Views, *, near_plane: float = 0.01, subsets: int = 5, seed: int = 0
) -> float | None:
    """The variance of renders of random halves: 0 where any half shows the same picture.

    Args:
        model: the Gaussians, on the CPU.
        views: from where to look; their images are not used.
        near_plane: of the renderer, in world units.
        subsets: how many halves a view, at least 2. The opacities of those that stay are not raised.
        seed: of the halves; each view has others.

    Returns:
        The variance between subsets (of clamped renders, unbiased), mean over channels and over the pixels of all views
        that have an alpha above 0.8 in every subset; None where there are no such pixels.

    Raises:
        ValueError: fewer than two subsets.
    """
    if subsets < 2:
        raise ValueError(f"subsets: expected at least 2, got {subsets}")
    renderer = GaussianRenderer(_RandomHalf(seed), near_plane=near_plane).eval()
    total, pixels = 0.0, 0
    gaussians = model()
    for view in range(len(views)):
        images, alphas = [], []
        for _ in range(subsets):
            out = renderer(gaussians, views.camera(view), outputs=("image", "alpha"))
            images.append(out.image[0].clamp(0, 1))
            alphas.append(out.alpha[0, 0])
        covered = (torch.stack(alphas) > COVERED).all(0)
        total += float(torch.stack(images).double().var(0).mean(0)[covered].sum())
        pixels += int(covered.sum())
    return total / pixels if pixels else None
