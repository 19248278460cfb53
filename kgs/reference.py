"""The reference: a dense float64 renderer of Gaussians, written to be easy to check, not to be fast.

Source: B. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023; M. Zwicker et al., "EWA
Volume Splatting", 2001. Every Gaussian meets every pixel, derivatives are autograd's, and no stage of the package is
used: covariances are formed and inverted, harmonics come from the recurrence of the Legendre functions.

Forming a covariance squares its condition: footprints up to 1e4 px keep 7 digits, needles of 1e7 px only two.
"""

import math
from dataclasses import dataclass

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.checks import check_intrinsics, check_kind, check_tensor
from kgs._support.default_device import cpu_by_default

from .geometry.types import Gaussians, RasterOptions

__all__ = ["Layers", "layers", "render"]


@dataclass(frozen=True, eq=False)
class Layers:
    """The L Gaussians in front of the camera from front to back, float64.

    Args:
        weights: share of each layer in each pixel, `(L, H, W)`.
        transmittance: transmittance behind the last layer, `(H, W)`.
        colors: `(L, 3)`.
        depths: z in the camera frame, `(L,)`.
        order: which Gaussian each layer is, `(L,)` int64.
        responses: o G before the clamp and all thresholds, `(L, H, W)`.
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
    alpha_threshold: float = RasterOptions.alpha_threshold,
    transmittance_stop: float = RasterOptions.transmittance_stop,
    near_plane: float = RasterOptions.near_plane,
    eps2d: float = RasterOptions.eps2d,
) -> Tensor:
    """Render one camera; differentiable with respect to the Gaussians, extrinsics, intrinsics and the background.

    Convention:
        World-to-camera extrinsics, OpenCV axes, pixels with integer centres.

    Args:
        gaussians: N Gaussians; those with a parameter that is not finite are left out.
        camera: one camera.
        background: None (black), `(3,)`, `(1, 3)` or `(1, 3, H, W)`.
        alpha_threshold: smaller alphas are skipped; 0 skips none.
        transmittance_stop: transmittance below this counts as 0; the layer that crosses it still counts.
        near_plane: only centres with z > near_plane are rendered; world units.
        eps2d: variance in px^2 added to each footprint; with 0 no footprint may be flat.

    Returns:
        The image `(1, 3, H, W)`, or `(1, D, H, W)` of features, which take no background; float64; with both thresholds
        0 the exact sum.

    Raises:
        TypeError: `gaussians` or `camera` is of another type.
        ValueError: more than one camera or row of opacities, intrinsics whose third row is not (0, 0, 1), or a
            background of another shape.
        torch.linalg.LinAlgError: `eps2d` is 0 and a footprint is flat.
    """
    stack = layers(gaussians, camera, alpha_threshold, transmittance_stop, near_plane, eps2d)
    image = torch.einsum("lhw,lc->chw", stack.weights, stack.colors)
    if background is not None:
        check_tensor("background", background)
        if tuple(background.shape) not in {(3,), (1, 3), (1, *image.shape)}:
            raise ValueError(f"background: expected (3,), (1, 3) or (1, 3, H, W), got {tuple(background.shape)}")
        behind = background.double().reshape(3, *(background.shape[2:] or (1, 1)))
        image = image + behind * stack.transmittance
    return image[None]


@cpu_by_default
def layers(
    gaussians: Gaussians,
    camera: PinholeCamera,
    alpha_threshold: float = RasterOptions.alpha_threshold,
    transmittance_stop: float = RasterOptions.transmittance_stop,
    near_plane: float = RasterOptions.near_plane,
    eps2d: float = RasterOptions.eps2d,
) -> Layers:
    """The layers that :func:`render` sums; see there for arguments and errors."""
    check_kind("gaussians", gaussians, Gaussians)
    check_kind("camera", camera, PinholeCamera)
    if camera.batch_size != 1 or gaussians.opacities.numel() != len(gaussians):
        shape = tuple(gaussians.opacities.shape)
        raise ValueError(f"camera: expected one camera and one row of opacities, got {camera.batch_size} and {shape}")
    check_intrinsics("camera", camera.intrinsics)
    height = int(camera.height)
    width = int(camera.width)
    intrinsics = camera.intrinsics[0, :2, :3].double()
    extrinsics = camera.extrinsics[0].double()
    rotation = extrinsics[:3, :3]
    translation = extrinsics[:3, 3]
    rows = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities.reshape(-1, 1), gaussians.colors)
    with torch.no_grad():
        z = gaussians.means.double() @ rotation[2] + translation[2]
        finite = torch.stack([value.isfinite().flatten(1).all(1) for value in rows]).all(0)
        front = (finite & (z > near_plane)).nonzero()[:, 0]
        order = front[z[front].argsort(stable=True)]
    means, quats, scales, opacities, colors = (value.index_select(0, order).double() for value in rows)

    points = means @ rotation.T + translation
    means2d = points @ intrinsics.T / points[:, 2:]
    pixels = torch.cartesian_prod(torch.arange(height), torch.arange(width)).flip(1).to(means)
    offsets = pixels - means2d[:, None]
    jacobians = _jacobians(points, intrinsics, height, width) @ rotation
    covariances = jacobians @ _covariances(quats, scales) @ jacobians.mT + eps2d * torch.eye(2).to(means)
    distances = torch.einsum("lpi,lij,lpj->lp", offsets, torch.linalg.inv(covariances), offsets)
    responses = (opacities * torch.exp(-distances / 2)).reshape(-1, height, width)

    alphas = responses.masked_fill(responses > 0.99, 0.99)
    alphas = torch.where(alphas >= alpha_threshold, alphas, 0.0)
    transmittance = torch.cat([torch.ones(1, height, width).to(alphas), torch.cumprod(1 - alphas, 0)])
    transmittance = torch.where(transmittance >= transmittance_stop, transmittance, 0.0)
    if colors.ndim == 3:
        directions = torch.nn.functional.normalize(means + torch.linalg.inv(rotation) @ translation, dim=1)
        colors = torch.einsum("lk,lkc->lc", _harmonics(directions, colors.shape[1]), colors) + 0.5
        colors = colors.masked_fill(colors < 0, 0.0)
    return Layers(alphas * transmittance[:-1], transmittance[-1], colors, points[:, 2], order, responses)


def _jacobians(points: Tensor, intrinsics: Tensor, height: int, width: int) -> Tensor:
    """Derivative of the pixel, with x/z and y/z limited to 15 % of the image size beyond its borders."""
    size = torch.tensor([width, height]).to(points)
    focal = intrinsics.diagonal()[:2]
    centre = intrinsics[:2, 2]
    ends = torch.stack([(-0.5 - centre - 0.15 * size) / focal, (size - 0.5 - centre + 0.15 * size) / focal])
    tangents = torch.clamp(points[:, :2] / points[:, 2:], ends.amin(0), ends.amax(0))
    plane = torch.cat([torch.eye(2).to(points).expand(len(points), 2, 2), -tangents[:, :, None]], 2)
    return intrinsics[:2, :2] @ plane / points[:, 2, None, None]


def _covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """R S S R^T with R = ((w^2 - |v|^2) I + 2 v v^T + 2 w [v]_x) / |q|^2; the zero quaternion gives the identity."""
    if quats.ndim == 3:  # R itself
        return quats @ torch.diag_embed(scales**2) @ quats.mT
    eye = torch.eye(3).to(quats)
    quats = torch.where((quats == 0).all(1, keepdim=True), torch.eye(4).to(quats)[0], quats)
    w = quats[:, :1, None]
    v = quats[:, None, 1:]
    square = (v * v).sum(2, keepdim=True)
    cross: Tensor = torch.linalg.cross(eye[None], v)
    rotations = ((w * w - square) * eye + 2 * v.mT @ v + 2 * w * cross) / (w * w + square)
    return rotations @ torch.diag_embed(scales**2) @ rotations.mT


def _harmonics(directions: Tensor, size: int) -> Tensor:
    """Real spherical harmonics with the Condon-Shortley sign, in the order (l, m) = (0, 0), (1, -1), (1, 0), ...

    Y_lm is N_lm P_lm(z) times Re (x + i y)^m or, for m < 0, Im (x + i y)^|m|; P_lm without its factor (1 - z^2)^(m/2).
    """
    x, y, z = directions.unbind(1)
    basis = [z] * size
    degree = math.isqrt(size) - 1
    power = torch.complex(torch.ones_like(x), torch.zeros_like(y))
    diagonal = 1.0
    for m in range(degree + 1):
        before = torch.zeros_like(z)
        legendre = torch.full_like(z, diagonal)
        for n in range(m, degree + 1):
            square = (1 if m == 0 else 2) * (2 * n + 1) / (4 * math.pi) * math.factorial(n - m) / math.factorial(n + m)
            basis[n * n + n - m] = (-1) ** m * math.sqrt(square) * legendre * power.imag
            basis[n * n + n + m] = (-1) ** m * math.sqrt(square) * legendre * power.real  # the one that stays for m = 0
            before, legendre = legendre, ((2 * n + 1) * z * legendre - (n + m) * before) / (n - m + 1)
        power = power * torch.complex(x, y)
        diagonal = (2 * m + 1) * diagonal
    return torch.stack(basis, 1)
