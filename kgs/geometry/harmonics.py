"""View-dependent colour by real spherical harmonics up to degree 3.

Source: P.-P. Sloan, "Efficient Spherical Harmonic Evaluation", JCGT 2(2), 2013; order and signs are those of the PLY
files of Kerbl et al. 2023.
"""

import math

import torch
from torch import Tensor

SH_C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3: tuple[float, ...] = (-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154)
_C3 += (-0.4570457994644658, 1.445305721320277, -0.5900435899266435)


def harmonics_basis(directions: Tensor, degree: int) -> Tensor:
    """The basis functions of degree 0 to 3 at unit vectors `(M, 3)` from the camera: `(M, (degree + 1)^2)`."""
    x, y, z = directions.unbind(1)
    basis = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        basis += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [_C2[0] * x * y, _C2[1] * y * z, _C2[2] * (2 * zz - xx - yy), _C2[3] * x * z, _C2[4] * (xx - yy)]
    if degree >= 3:
        basis += [_C3[0] * y * (3 * xx - yy), _C3[1] * x * y * z, _C3[2] * y * (4 * zz - xx - yy)]
        basis += [_C3[3] * z * (2 * zz - 3 * xx - 3 * yy), _C3[4] * x * (4 * zz - xx - yy)]
        basis += [_C3[5] * z * (xx - yy), _C3[6] * x * (xx - 3 * yy)]
    return torch.stack(basis, 1)


def evaluate_harmonics(colors: Tensor, directions: Tensor) -> Tensor:
    """Colours max(0, 0.5 + sum_k b_k(direction) c_k); at exactly 0 the gradient passes.

    Args:
        colors: coefficients, `(M, K, 3)` with K = 1, 4, 9 or 16; only these bands are evaluated.
        directions: unit vectors from the camera to the Gaussians in world axes, `(M, 3)`; unused for K = 1.
    """
    if colors.shape[1] == 1:
        value = SH_C0 * colors[:, 0] + 0.5
    else:
        basis = harmonics_basis(directions, math.isqrt(colors.shape[1]) - 1)
        value = (basis[:, :, None] * colors).sum(1) + 0.5
    return value.masked_fill(value < 0, 0.0)  # the gradient of clamp_min at 0 depends on torch's version
