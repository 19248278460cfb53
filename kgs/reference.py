"""The oracle: a dense float64 renderer of Gaussians, meant to be read and believed rather than to be fast.

Source: Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023; Zwicker et al., "EWA Volume
Splatting", 2001. Every Gaussian meets every pixel, derivatives are autograd's, and no stage of the package is used:
covariances are formed and inverted, harmonics come from the recurrence of the associated Legendre polynomials.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from .types import Gaussians

__all__ = ["Layers", "layers", "render"]


class Layers(NamedTuple):
    """The L Gaussians in front of the camera, front to back: weights and raw responses o G `(L, H, W)`, the light that
    remains `(H, W)`, colours `(L, 3)`, depths `(L,)` and indices into the Gaussians `(L,)`; float64.
    """

    weights: Tensor
    transmittance: Tensor
    colors: Tensor
    depths: Tensor
    order: Tensor
    responses: Tensor


def render(
    gaussians: Gaussians,
    camera: PinholeCamera,
    background: Tensor | None = None,
    alpha_threshold: float = 1 / 255,
    transmittance_stop: float = 1e-4,
    near_plane: float = 0.01,
    eps2d: float = 0.3,
) -> Tensor:
    """Render one camera exactly; differentiable with respect to all Gaussians' parameters, the camera and background.

    Convention:
        World-to-camera extrinsics, OpenCV axes, pixels with integer centres.

    Args:
        gaussians: N Gaussians of any dtype; those with a parameter that is not finite are left out.
        camera: one camera.
        background: None (black), `(3,)`, `(1, 3)` or `(1, 3, H, W)`.
        alpha_threshold: smaller alphas are skipped; 0 skips none.
        transmittance_stop: once less light than this remains, none does (inclusive: the layer that crosses it counts).
        near_plane: only centres with z > near_plane are drawn, world units.
        eps2d: variance added to each footprint, px^2; with 0 no footprint may be flat.

    Returns:
        The image `(1, 3, H, W)`, float64; with both thresholds 0 the exact sum.

    Raises:
        TypeError: `camera` is no `PinholeCamera`.
        ValueError: not exactly one camera or set of opacities.
    """
    drawn = layers(gaussians, camera, alpha_threshold, transmittance_stop, near_plane, eps2d)
    image = torch.einsum("lhw,lc->chw", drawn.weights, drawn.colors)
    if background is not None:
        behind = background.double().reshape(3, *background.shape[2:])
        image = image + drawn.transmittance * (behind if behind.ndim == 3 else behind[:, None, None])
    return image[None]


def layers(
    gaussians: Gaussians,
    camera: PinholeCamera,
    alpha_threshold: float = 1 / 255,
    transmittance_stop: float = 1e-4,
    near_plane: float = 0.01,
    eps2d: float = 0.3,
) -> Layers:
    """What `render` adds up: see there for the arguments."""
    if not isinstance(camera, PinholeCamera):
        raise TypeError(f"camera: expected a kornia PinholeCamera, got {type(camera).__name__}")
    if camera.batch_size != 1 or gaussians.opacities.numel() != len(gaussians):
        raise ValueError(
            "camera, opacities: expected one camera and (N,) or (1, N) opacities, "
            f"got {camera.batch_size} and {tuple(gaussians.opacities.shape)}"
        )
    height, width = int(camera.height), int(camera.width)
    intrinsics, extrinsics = camera.intrinsics[0, :3, :3].double(), camera.extrinsics[0].double()
    rotation, translation = extrinsics[:3, :3], extrinsics[:3, 3]
    rows = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities.reshape(-1), gaussians.colors]
    with torch.no_grad():
        z = gaussians.means.double() @ rotation[2] + translation[2]
        finite = torch.stack([value.reshape(len(gaussians), -1).isfinite().all(1) for value in rows]).all(0)
        kept = (finite & (z > near_plane)).nonzero()[:, 0]
        order = kept[z[kept].argsort(stable=True)]
    means, quats, scales, opacities, colors = (value.index_select(0, order).double() for value in rows)

    points = means @ rotation.T + translation
    homogeneous = points @ intrinsics.T
    means2d = homogeneous[:, :2] / homogeneous[:, 2:]
    offsets = _pixels(height, width).to(means2d)[None] - means2d[:, None]
    jacobians = _jacobians(points, intrinsics, height, width) @ rotation
    covariances = jacobians @ _covariances(quats, scales) @ jacobians.mT + eps2d * torch.eye(2).to(means)
    squared = torch.einsum("lpi,lij,lpj->lp", offsets, torch.linalg.inv(covariances), offsets)
    responses = (opacities[:, None] * torch.exp(-squared / 2)).reshape(-1, height, width)

    alphas = responses.clamp(max=0.99)
    alphas = torch.where(alphas >= alpha_threshold, alphas, 0.0)
    light = torch.cat([torch.ones(1, height, width).to(alphas), torch.cumprod(1 - alphas, 0)])
    light = torch.where(light >= transmittance_stop, light, 0.0)
    if colors.ndim == 3:
        directions = torch.nn.functional.normalize(means + rotation.T @ translation, dim=1)
        colors = (torch.einsum("lk,lkc->lc", _harmonics(directions, colors.shape[1]), colors) + 0.5).clamp(min=0)
    return Layers(alphas * light[:-1], light[-1], colors, points[:, 2], order, responses)


def _pixels(height: int, width: int) -> Tensor:
    return torch.cartesian_prod(torch.arange(height), torch.arange(width)).flip(1)


def _jacobians(points: Tensor, intrinsics: Tensor, height: int, width: int) -> Tensor:
    """d pixel / d point, with x/z and y/z limited to 15 % of the image size beyond its borders."""
    size = torch.tensor([width, height]).to(points)
    focal, centre = intrinsics.detach().diagonal()[:2], intrinsics.detach()[:2, 2]
    low, high = (-0.5 - centre - 0.15 * size) / focal, (size - 0.5 - centre + 0.15 * size) / focal
    z = points[:, 2:]
    tangents = torch.clamp(points[:, :2] / z, low, high)
    plane = torch.cat([torch.eye(2).to(points).expand(len(points), 2, 2), -tangents[:, :, None]], 2)
    return intrinsics[:2, :2] @ plane / z[:, :, None]


def _covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """R S S R^T with R = ((w^2 - |v|^2) I + 2 v v^T + 2 w [v]_x) / |q|^2; the zero quaternion turns nothing."""
    eye = torch.eye(3).to(quats)
    quats = torch.where((quats == 0).all(1, keepdim=True), torch.eye(4).to(quats)[0], quats)
    w, v = quats[:, :1, None], quats[:, None, 1:]
    norm = (v * v).sum(2, keepdim=True)
    rotations = ((w * w - norm) * eye + 2 * v.mT @ v + 2 * w * torch.linalg.cross(eye[None], v)) / (w * w + norm)
    return rotations @ torch.diag_embed(scales**2) @ rotations.mT


def _harmonics(directions: Tensor, size: int) -> Tensor:
    """Y_lm = (-1)^m sqrt(2 - [m = 0]) N_lm P_lm(z) Re or Im (x + i y)^|m|, with m < 0 the imaginary part.

    P_lm is the associated Legendre function without its factor (1 - z^2)^(m/2), which belongs to x + i y.
    """
    x, y, z = directions.unbind(1)
    degree = math.isqrt(size) - 1
    basis = [torch.empty(0)] * size
    real, imaginary, diagonal = torch.ones_like(x), torch.zeros_like(x), 1.0
    for m in range(degree + 1):
        before, legendre = torch.zeros_like(z), diagonal * torch.ones_like(z)
        for n in range(m, degree + 1):
            square = (2 * n + 1) / (4 * math.pi) * math.factorial(n - m) / math.factorial(n + m)
            factor = (-1) ** m * math.sqrt(square if m == 0 else 2 * square)
            basis[n * n + n - m] = factor * legendre * imaginary
            basis[n * n + n + m] = factor * legendre * real
            before, legendre = legendre, ((2 * n + 1) * z * legendre - (n + m) * before) / (n - m + 1)
        real, imaginary, diagonal = x * real - y * imaginary, x * imaginary + y * real, (2 * m + 1) * diagonal
    return torch.stack(basis, 1)
