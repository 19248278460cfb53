"""The L1 penalty on opacities that DropGaussian is compared with.

Source: H. Park, G. Ryu, W. Kim, "DropGaussian" (CVPR 2025) compares dropping with an L1 penalty "by gradient" and "by
distance" and defines neither. The weighting by ranks is this project's reading.
"""

import torch
from torch import Tensor


def opacity_l1(opacities: Tensor, scores: Tensor) -> Tensor:
    """The mean of the opacities, each weighted by (rank - 1/2) / N with the rank of its score from 1 to N.

    Equal scores share the mean of their ranks. So the weights have mean 1/2 whatever the scores are, and nothing
    depends on the order of the Gaussians.

    Args:
        opacities: activated, in [0, 1], `(N,)` (else a ValueError); the gradient goes to these alone.
        scores: which Gaussians to penalise more, `(N,)` (else a ValueError), in any unit.

    Returns:
        A number in [0, 1]; 0 where there are no Gaussians.

    Examples:
        >>> opacity_l1(torch.tensor([0.5, 0.5, 1.0]), torch.tensor([1.0, 7.0, 2.0]))
        tensor(0.3333)
    """
    if opacities.ndim != 1:
        raise ValueError(f"opacities: expected shape (N,), got {tuple(opacities.shape)}")
    if scores.shape != opacities.shape:
        raise ValueError(f"scores: expected shape {tuple(opacities.shape)}, got {tuple(scores.shape)}")
    ordered = scores.detach().sort().values
    below, not_above = (torch.searchsorted(ordered, scores.detach(), right=right) for right in (False, True))
    weights = (below + not_above).to(opacities.dtype) / (2 * max(len(scores), 1))
    return (weights * opacities).sum() / max(len(opacities), 1)
