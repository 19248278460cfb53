"""From a Gaussian's rotation and scales to its footprint in the image, without ever forming a 3x3 covariance.

Source: M. Zwicker, H. Pfister, J. van Baar, M. Gross, "EWA Volume Splatting", IEEE Visualization 2001 (the first-order
footprint); B. Kerbl et al., "3D Gaussian Splatting", 2023, section 4 (Sigma = R S S^T R^T).

The footprint is kept as the 2x3 factor M = J W R S of Sigma' = M M^T + e I. With rows m1, m2 the determinant is

    det Sigma' = |m1 x m2|^2 + e (|m1|^2 + |m2|^2) + e^2          (Cauchy-Binet)

a sum of terms >= 0: no cancellation, never a non-positive value, for needles of 1e6 : 1 as well. The usual
a c - b^2 is non-positive for half of those in float32.
"""

from __future__ import annotations

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor

__all__ = ["conics", "footprint_factors", "rotation_matrices", "variances", "whitening"]


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices of quaternions of any norm.

    Convention:
        Order w, x, y, z. The columns are the Gaussian's local axes in the world. The zero quaternion gives the
        identity with zero gradient.

    Args:
        quats: shape `(N, 4)`; norms from 1e-30 to 1e30 give the same matrix.

    Returns:
        Shape `(N, 3, 3)`.
    """
    peak = quats.detach().abs().amax(-1, keepdim=True)
    return quaternion_to_rotation_matrix(quats / torch.where(peak > 0, peak, 1.0))


def footprint_factors(rows: Tensor, quats: Tensor, scales: Tensor) -> Tensor:
    """The 2x3 factors M = (J W) R S.

    Args:
        rows: J W, the derivative of the pixel with respect to the world point, `(M, 2, 3)`.
        quats: `(M, 4)`.
        scales: `(M, 3)`.

    Returns:
        `(M, 2, 3)` in pixels.
    """
    return torch.bmm(rows, rotation_matrices(quats)) * scales[:, None, :]


def variances(factors: Tensor, eps2d: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Entries xx, xy, yy and determinant of M M^T + eps2d I, each `(M,)`."""
    mx, my = factors.unbind(1)
    xx, xy, yy = (mx * mx).sum(1), (mx * my).sum(1), (my * my).sum(1)
    cross = torch.linalg.cross(mx, my)
    det = (cross * cross).sum(1) + eps2d * (xx + yy) + eps2d**2
    return xx + eps2d, xy, yy + eps2d, det


def conics(factors: Tensor, eps2d: float) -> Tensor:
    """Inverse covariances (a, b, c) of a dx^2 + 2 b dx dy + c dy^2, `(M, 3)`."""
    xx, xy, yy, det = variances(factors, eps2d)
    return torch.stack([yy / det, -xy / det, xx / det], 1)


def whitening(xx: Tensor, xy: Tensor, yy: Tensor, det: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Two vectors a, b with d^T Sigma'^-1 d = (a . d)^2 + (b . d)^2, as (a_x, a_y, b_x, b_y).

    An LDL^T factorisation with the larger variance as pivot: the form in which the exponent keeps its accuracy
    for needles.
    """
    x_larger = xx >= yy
    pivot = torch.where(x_larger, xx, yy)
    slope = -xy / pivot
    along = pivot.rsqrt()
    across = (pivot / det).sqrt()
    zero = torch.zeros_like(along)
    return (
        torch.where(x_larger, slope * across, across),
        torch.where(x_larger, across, slope * across),
        torch.where(x_larger, along, zero),
        torch.where(x_larger, zero, along),
    )
