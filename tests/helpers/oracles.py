"""Oracles for tests, none of which uses a formula of the package."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import mpmath
import torch
from kornia.geometry.camera import PinholeCamera
from mpmath import mpf
from torch import Tensor

from kgs import Gaussians
from kgs.reference import layers


def near_threshold(
    gaussians: Gaussians,
    camera: PinholeCamera,
    alpha_threshold: float = 1 / 255,
    transmittance_stop: float = 1e-4,
    near_plane: float = 0.01,
    eps2d: float = 0.3,
    rel: float = 1e-5,
) -> Tensor:
    """Pixels `(H, W)` where some layer is so close to a decision that rounding may take the other side."""
    responses = layers(gaussians, camera, alpha_threshold, transmittance_stop, near_plane, eps2d).responses.detach()

    def close(value: Tensor, limit: float) -> Tensor:
        return (value - limit).abs() < rel * limit

    alphas = responses.clamp(max=0.99) * (responses >= alpha_threshold)
    light = torch.cumprod(1 - alphas, 0)
    return (close(responses, alpha_threshold) | close(responses, 0.99) | close(light, transmittance_stop)).any(0)


def enumerate_drops(n: int, rate: float, render: Callable[[Tensor], Tensor]) -> Tensor:
    """Exact expectation of `render(factors)` over all 2^n masks: each factor is 0 or 1 / (1 - rate)."""
    total: Tensor | None = None
    for kept in itertools.product((False, True), repeat=n):
        probability = (1 - rate) ** sum(kept) * rate ** (n - sum(kept))
        term = probability * render(torch.tensor(kept, dtype=torch.float64) / (1 - rate))
        total = term if total is None else total + term
    assert total is not None
    return total


def theta_mass(variance: float, centre: float) -> float:
    """Sum over all integers k of exp(-(k - centre)^2 / (2 variance)), by Jacobi's theta function."""
    with mpmath.workdps(50):
        nome = mpmath.exp(-2 * mpmath.pi**2 * mpf(variance))
        return float(mpmath.sqrt(2 * mpmath.pi * mpf(variance)) * mpmath.jtheta(3, mpmath.pi * mpf(centre), nome))


def mpmath_pixels(
    gaussians: Gaussians,
    camera: PinholeCamera,
    pixels: Sequence[tuple[int, int]],
    background: Sequence[float] = (0.0, 0.0, 0.0),
    alpha_threshold: float = 0.0,
    transmittance_stop: float = 0.0,
    near_plane: float = 0.01,
    eps2d: float = 0.3,
) -> list[list[float]]:
    """Colours of the pixels (row, column) with 50 digits, Gaussian by Gaussian; colours RGB or harmonics."""
    with mpmath.workdps(50):
        k, pose = (mpmath.matrix(m[0].tolist())[:3, :] for m in (camera.intrinsics, camera.extrinsics))
        means = [mpmath.matrix(mean) for mean in gaussians.means.tolist()]
        points = [pose[:, :3] * mean + pose[:, 3] for mean in means]
        drawn = []
        for i in sorted(range(len(means)), key=lambda i: points[i][2]):
            if points[i][2] > near_plane:
                conic = _mp_covariance(gaussians, i, points[i], k, pose, camera, eps2d) ** -1
                centre = k[:, :3] * points[i]
                color = _mp_color(gaussians.colors[i], means[i] + pose[:, :3].T * pose[:, 3])
                drawn.append((centre[:2] / centre[2], conic, mpf(gaussians.opacities.reshape(-1)[i].item()), color))
        return [_mp_pixel(drawn, *pixel, background, alpha_threshold, transmittance_stop) for pixel in pixels]


def real_harmonic(index: int, polar: mpf, azimuth: mpf) -> mpf:
    """Real spherical harmonic number l^2 + l + m from mpmath's complex one (which has the Condon-Shortley sign)."""
    degree = math.isqrt(index)
    m = index - degree * degree - degree
    value = mpmath.spherharm(degree, abs(m), polar, azimuth)
    return value.real if m == 0 else mpmath.sqrt(2) * (value.real if m > 0 else value.imag)


def quaternion_product(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton's product of quaternions w, x, y, z."""
    p, q = torch.broadcast_tensors(p, q)
    vector = p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + torch.linalg.cross(p[..., 1:], q[..., 1:], dim=-1)
    return torch.cat([p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(-1, keepdim=True), vector], -1)


def _mp_covariance(gaussians: Gaussians, i: int, point, k, pose, camera: PinholeCamera, eps2d: float):
    w, x, y, z = (mpf(value) for value in gaussians.quats[i].tolist())
    first = [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)]
    second = [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)]
    third = [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z]
    turn = pose[:, :3] * mpmath.matrix([first, second, third]) / (w * w + x * x + y * y + z * z)
    tangents = []
    for axis, size in enumerate((int(camera.width), int(camera.height))):
        left, right = -mpf(1) / 2 - mpf("0.15") * size, size - mpf(1) / 2 + mpf("0.15") * size
        low, high = (left - k[axis, 2]) / k[axis, axis], (right - k[axis, 2]) / k[axis, axis]
        tangents.append(min(max(point[axis] / point[2], low), high))
    jacobian = k[:2, :2] * mpmath.matrix([[1, 0, -tangents[0]], [0, 1, -tangents[1]]]) / point[2]
    square = mpmath.diag([mpf(scale) ** 2 for scale in gaussians.scales[i].tolist()])
    return jacobian * turn * square * turn.T * jacobian.T + mpf(eps2d) * mpmath.eye(2)


def _mp_color(color: Tensor, direction) -> list[mpf]:
    if color.ndim == 1:
        return [mpf(value) for value in color.tolist()]
    polar = mpmath.acos(direction[2] / mpmath.norm(direction))
    basis = [real_harmonic(index, polar, mpmath.atan2(direction[1], direction[0])) for index in range(len(color))]
    sums = [mpmath.fdot(basis, map(mpf, column)) for column in color.T.tolist()]
    return [max(mpf(1) / 2 + value, mpf(0)) for value in sums]


def _mp_pixel(drawn, row: int, column: int, background, threshold: float, stop: float) -> list[float]:
    light, total = mpf(1), [mpf(0)] * 3
    for centre, conic, opacity, color in drawn:
        d = mpmath.matrix([column, row]) - centre
        alpha = min(mpf("0.99"), opacity * mpmath.exp(-(d.T * conic * d)[0] / 2))
        if alpha >= threshold and light >= stop:
            total = [value + light * alpha * c for value, c in zip(total, color, strict=True)]
            light *= 1 - alpha
    light = light if light >= stop else mpf(0)
    return [float(value + light * mpf(b)) for value, b in zip(total, background, strict=True)]
