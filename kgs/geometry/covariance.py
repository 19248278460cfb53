"""From a Gaussian's rotation and scales to its footprint in the image, without ever forming a 3x3 covariance.

Source: M. Zwicker, H. Pfister, J. van Baar, M. Gross, "EWA Volume Splatting", IEEE Visualization 2001 (the first-order
footprint); B. Kerbl et al., "3D Gaussian Splatting", 2023, section 4 (Sigma = R S S^T R^T).

The footprint is kept as the 2x3 factor M = J W R S of Sigma' = M M^T + e I. With rows m1, m2 the determinant is

    det Sigma' = |m1 x m2|^2 + e (|m1|^2 + |m2|^2) + e^2          (Cauchy-Binet)

a sum of terms >= 0: no cancellation, never a non-positive value, for needles of 1e6 : 1 as well. The usual
a c - b^2 is non-positive for half of those in float32.
"""

from collections.abc import Sequence
from typing import Any

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor

from kgs._support.autograd import refuse_second_derivative


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices `(N, 3, 3)` of quaternions w, x, y, z of any norm, `(N, 4)`; matrices are returned as they are.

    The columns are the Gaussian's local axes in the world. The zero quaternion gives the identity with zero gradient.
    """
    if quats.ndim == 3:
        return quats
    peak = quats.detach().abs().amax(-1, keepdim=True)
    return quaternion_to_rotation_matrix(quats / torch.where(peak > 0, peak, 1.0))


def footprint_factors(rows: Tensor, quats: Tensor, scales: Tensor) -> Tensor:
    """The factors M = (J W) R S `(M, 2, 3)` in pixels; `rows` are J W, from the world point to the pixel, `(M, 2, 3)`.

    Differentiable once, in closed form on columns of numbers: batched products of tiny matrices are ten times slower.
    `quats` are quaternions, or the matrices R themselves.
    """
    if quats.ndim == 3:
        axes = quats * scales[:, None]
        turned: Tensor = (rows[:, :, :, None] * axes[:, None]).sum(2)
        return turned
    factors: Tensor = _FootprintFactors.apply(rows, quats, scales)[0]
    return factors


class _FootprintFactors(torch.autograd.Function):
    """`footprint_factors` of quaternions, and what their gradient needs."""

    @staticmethod
    def forward(rows: Tensor, quats: Tensor, scales: Tensor) -> tuple[Tensor, ...]:
        a = columns(rows)
        s = columns(scales)
        peak = quats.abs().amax(1)
        q = columns(quats).div_(torch.where(peak > 0, peak, 1.0))
        norm = q.square().sum(0).sqrt()
        q.div_(torch.where(norm > 0, norm, 1.0))
        q[0].masked_fill_(norm == 0, 1.0)
        inverse_norm = torch.where(norm > 0, 1.0 / (norm * peak), 0.0)
        r = _rotation_columns(q)
        turned = torch.stack([_dot(a[3 * i : 3 * i + 3], r[j::3]) for i in (0, 1) for j in (0, 1, 2)])
        factors: Tensor = (turned.unflatten(0, (2, 3)) * s).permute(2, 0, 1).contiguous()
        return factors, a, q, inverse_norm, s, turned

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
        ctx.save_for_backward(*output[1:])
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, grad: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        refuse_second_derivative("project")
        if grad is None:
            return None, None, None
        a, q, inverse_norm, s, turned = ctx.saved_tensors
        d_rows = d_quats = d_scales = None
        g = columns(grad)
        if ctx.needs_input_grad[2]:
            d_scales = (turned * g).unflatten(0, (2, 3)).sum(0).t()
        g = (g.unflatten(0, (2, 3)) * s).flatten(0, 1)
        if ctx.needs_input_grad[0]:
            r = _rotation_columns(q)
            parts = [_dot(g[3 * i : 3 * i + 3], r[3 * k : 3 * k + 3]) for i in (0, 1) for k in (0, 1, 2)]
            d_rows = torch.stack(parts, 1).unflatten(1, (2, 3))
        if ctx.needs_input_grad[1]:
            d_rotations = (a.unflatten(0, (2, 3, 1)) * g.unflatten(0, (2, 1, 3))).sum(0)
            d_quats = _quaternion_gradient(q, d_rotations).mul_(inverse_norm).t()
        return d_rows, d_quats, d_scales


def covariance_factors(covariances: Tensor) -> Tensor:
    """Matrices A with A A^T = Sigma for covariances Sigma `(N, 3, 3)`: `quats` of Gaussians whose scales are 1.

    A Cholesky factorisation in float64: of needles it adds no error to that which Sigma was rounded with. What is left
    of a variance counts as at least the rounding of its entry, and a negative one as 0. The upper and the lower
    triangle are averaged. A covariance with an entry that is not finite gives NaN.

    The gradient is (G A^-1 + (G A^-1)^T) / 4 of a gradient G by A: right for every function of A A^T, once. In float32
    its error is about 1e-7 times the ratio of the longest to the shortest axis; of an axis of length 0 it is 0.
    """
    factors: Tensor = _HalfAxes.apply(covariances)[0]
    return factors


class _HalfAxes(torch.autograd.Function):
    """`covariance_factors`, and the same in float64, which the gradient needs."""

    @staticmethod
    def forward(covariances: Tensor) -> tuple[Tensor, Tensor]:
        xx, xy, xz, yx, yy, yz, zx, zy, zz = covariances.double().flatten(1).unbind(1)
        xy = (xy + yx) / 2
        xz = (xz + zx) / 2
        yz = (yz + zy) / 2
        rounding = torch.finfo(covariances.dtype).eps
        a = xx.clamp_min(0.0).sqrt()
        into_a = torch.where(a > 0, 1.0 / a, 0.0)
        b = xy * into_a
        c = xz * into_a
        d = torch.maximum(yy - b * b, rounding * yy).clamp_min(0.0).sqrt()
        e = (yz - b * c) * torch.where(d > 0, 1.0 / d, 0.0)
        f = torch.maximum(zz - c * c - e * e, rounding * zz).clamp_min(0.0).sqrt()
        zero = torch.zeros_like(a)
        factors = torch.stack([a, zero, zero, b, d, zero, c, e, f], 1).unflatten(1, (3, 3))
        finite = covariances.isfinite().flatten(1).all(1)
        factors = factors.masked_fill(~finite[:, None, None], torch.nan)
        return factors.to(covariances.dtype, copy=True), factors

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: tuple[Tensor, Tensor]) -> None:
        ctx.save_for_backward(output[1])
        ctx.mark_non_differentiable(output[1])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> Tensor:
        refuse_second_derivative("covariance_factors")
        (factors,) = ctx.saved_tensors
        flat = factors.diagonal(dim1=1, dim2=2) == 0  # the gradient is 0 there, too
        whole = factors + torch.diag_embed(flat.double())
        solved = torch.linalg.solve_triangular(whole, grad.double(), upper=False, left=False)
        d_covariances: Tensor = ((solved + solved.mT) / 4).to(grad.dtype)
        finite = factors.isfinite().all(-1, keepdim=True).all(-2, keepdim=True)
        return d_covariances.masked_fill_(~finite, 0.0)


def columns(rows: Tensor) -> Tensor:
    """`(M, ...)` as one contiguous column per number, `(numbers, M)`; always a copy."""
    return rows.flatten(1).t().clone(memory_format=torch.contiguous_format)


def _dot(u: Sequence[Tensor] | Tensor, v: Sequence[Tensor] | Tensor) -> Tensor:
    """The dot products of columns of 3-vectors."""
    return torch.addcmul(torch.addcmul(u[0] * v[0], u[1], v[1]), u[2], v[2])


def _rotation_columns(q: Tensor) -> list[Tensor]:
    """The nine entries, row by row, of the rotations of unit quaternions `(4, M)`."""
    w, x, y, z = q
    xx = 2 * x * x
    yy = 2 * y * y
    zz = 2 * z * z
    xy = 2 * x * y
    xz = 2 * x * z
    yz = 2 * y * z
    wx = 2 * w * x
    wy = 2 * w * y
    wz = 2 * w * z
    return [1 - yy - zz, xy - wz, xz + wy, xy + wz, 1 - xx - zz, yz - wx, xz - wy, yz + wx, 1 - xx - yy]


def _quaternion_gradient(q: Tensor, d: Tensor) -> Tensor:
    """From dL/dR `(3, 3, M)` to dL/dq `(4, M)` along the unit sphere, for q of norm 1."""
    w, x, y, z = q
    px = d[2, 1] - d[1, 2]
    py = d[0, 2] - d[2, 0]
    pz = d[1, 0] - d[0, 1]
    sxy = d[0, 1] + d[1, 0]
    sxz = d[0, 2] + d[2, 0]
    syz = d[1, 2] + d[2, 1]
    dx, dy, dz = [2 * (d[i, i] - d[0, 0] - d[1, 1] - d[2, 2]) for i in (0, 1, 2)]
    dw = x * px + y * py + z * pz
    dx = w * px + x * dx + y * sxy + z * sxz
    dy = w * py + y * dy + x * sxy + z * syz
    dz = w * pz + z * dz + x * sxz + y * syz
    d_quats = torch.stack([dw, dx, dy, dz]).mul_(2)
    return d_quats.sub_(q * (q * d_quats).sum(0))


def variances(factors: Tensor, eps2d: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Entries xx, xy, yy and determinant of M M^T + eps2d I, each `(M,)`."""
    a, b = columns(factors).unflatten(0, (2, 3))
    xx = _dot(a, a)
    xy = _dot(a, b)
    yy = _dot(b, b)
    cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    det = _dot(cross, cross) + eps2d * (xx + yy) + eps2d**2
    return xx + eps2d, xy, yy + eps2d, det


def conics(xx: Tensor, xy: Tensor, yy: Tensor, det: Tensor) -> Tensor:
    """Inverse covariances (a, b, c) of a dx^2 + 2 b dx dy + c dy^2, `(M, 3)`."""
    return torch.stack([yy / det, -xy / det, xx / det], 1)


def compensations(factors: Tensor, eps2d: float) -> Tensor:
    """sqrt(det M M^T / det(M M^T + eps2d I)), `(M,)`: with this factor, eps2d does not change a footprint's integral.

    The numerator is the norm of a x b for the rows a, b of M, so nothing is cancelled; its gradient is 0 where it is 0.
    """
    a, b = factors.unbind(1)
    area: Tensor = torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=1)
    det = variances(factors, eps2d)[3]
    return area * det.rsqrt()


def reach(xx: Tensor, yy: Tensor) -> Tensor:
    """The reach of footprints along x and y in pixels, `(M, 2)`: 3.33 standard deviations, rounded up."""
    return (3.33 * torch.stack([xx, yy], 1).sqrt()).ceil()


def whitening(xx: Tensor, xy: Tensor, yy: Tensor, det: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Two vectors a, b with d^T Sigma'^-1 d = (a . d)^2 + (b . d)^2, as (a_x, a_y, b_x, b_y).

    An LDL^T factorisation with the larger variance as pivot: so the exponent keeps its accuracy for needles.
    """
    x_larger = xx >= yy
    pivot = torch.where(x_larger, xx, yy)
    slope = -xy / pivot
    along = pivot.rsqrt()
    across = (pivot / det).sqrt()
    zero = torch.zeros_like(along)
    ax = torch.where(x_larger, slope * across, across)
    ay = torch.where(x_larger, across, slope * across)
    bx = torch.where(x_larger, along, zero)
    by = torch.where(x_larger, zero, along)
    return ax, ay, bx, by


def footprint_table(means2d: Tensor, factors: Tensor, opacities: Tensor, eps2d: float) -> Tensor:
    """`(7, M)` for compositing: ln o; x, y; the two whitening vectors."""
    x, y = means2d.unbind(1)
    return torch.stack([opacities.log(), x, y, *whitening(*variances(factors, eps2d))])


def moment_gradients(rows: Tensor, factors: Tensor, opacities: Tensor, eps2d: float) -> tuple[Tensor, Tensor, Tensor]:
    """From the spatial moments s of dL/d ln alpha, `(n, 6)`, to gradients of means2d, factors and opacities.

    With the conic Q: dL/d mean = Q s_1 and, for Sigma' = M M^T + e I, dL/dM = Q S_2 (Q M). With the
    rows a, b of M and w = a x b the rows of det Q M are e a + b x w and e b + w x a, without the cancellation of a
    product: a needle's long axis is nearly in the kernel of Q.
    """
    s0, sx, sy, sxx, sxy, syy = columns(rows)
    xx, xy, yy, det = variances(factors, eps2d)

    def conic(x: Tensor, y: Tensor) -> Tensor:
        return torch.stack([yy * x - xy * y, xx * y - xy * x]).div_(det)

    m = columns(factors).unflatten(0, (2, 3))
    a, b = m
    w = torch.linalg.cross(a, b, dim=0)
    turned = torch.stack([torch.linalg.cross(b, w, dim=0), torch.linalg.cross(w, a, dim=0)])
    x, y = turned.add_(m, alpha=eps2d).div_(det)  # Q M
    flat = ~(det < torch.inf)  # the footprint overflows: constant over the image
    d_means = conic(sx, sy).masked_fill_(flat, 0.0)
    d_factors = conic(sxx * x + sxy * y, sxy * x + syy * y).masked_fill_(flat, 0.0)
    return d_means.t(), d_factors.permute(2, 0, 1), s0 / opacities
