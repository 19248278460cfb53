"""The photometric loss of Gaussian splatting: L1 + w (1 - SSIM), with an analytic gradient.

Sources: B. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023, eq. 7, in the
form L1 + w (1 - SSIM); Z. Wang et al., "Image quality assessment: from error visibility to structural similarity",
IEEE TIP 13(4), 2004, eq. 13:

    S = a b / (c d + eps),   a = 2 m_x m_y + c1,   b = 2 s_xy + c2,   c = m_x^2 + m_y^2 + c1,   d = s_xx + s_yy + c2

with m and s the mean, variance and covariance under the window around a pixel. Window (11 taps, standard deviation
1.5), constants, `eps` and reflected border are Kornia's: the result is that of `l1_loss + 2 w kornia.losses.ssim_loss`.
Rounding may take the SSIM of nearly equal images above 1. Kornia therefore clamps the SSIM of each pixel; here its mean
is clamped, and the gradient is not.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from kornia.filters import get_gaussian_kernel1d
from kornia.losses import ssim_loss
from torch import Tensor

from kgs._support.autograd import refuse_second_derivative
from kgs._support.errors import ArgumentError
from kgs.backends import Backend, get_backend

WINDOW = 11  # pixels
SIGMA = 1.5  # pixels, the standard deviation
RADIUS = WINDOW // 2
BORDER = [RADIUS] * 4
C1 = 0.01**2
C2 = 0.03**2
EPS = 1e-12


@dataclass(frozen=True, eq=False)
class TargetMoments:
    """Local mean and variance of a target, as the SSIM needs them; images and channels share one axis.

    Args:
        padded: the target with its reflected border, `(1, B C, H + 10, W + 10)`.
        mean: local mean, `(1, B C, H, W)`.
        variance: local variance, `(1, B C, H, W)`.
    """

    padded: Tensor
    mean: Tensor
    variance: Tensor


def photometric_loss(
    image: Tensor,
    target: Tensor | TargetMoments,
    dssim_weight: float = 0.2,
    *,
    mask: Tensor | None = None,
    fast: bool = True,
    moments: TargetMoments | None = None,
    backend: str | Backend = "auto",
) -> Tensor:
    """Mean absolute difference plus `dssim_weight` times 1 - SSIM, as in the release of DropGaussian.

    3DGS and gsplat weight (1 - l) L1 + l (1 - SSIM). Their l = 0.2 is `0.8 * photometric_loss(image, target, 0.25)`,
    but for the border of SSIM.

    Images in float32 of at least 11 x 11 pixels take a path with an analytic gradient, three times as fast as Kornia's;
    all others, targets that require a gradient, and `fast=False` take `kornia.losses.ssim_loss`.

    Args:
        image: `(B, C, H, W)`, float32 or float64, H, W >= 6 (any at weight 0); meant for [0, 1], never clamped.
        target: like `image`, or `target_moments` of such an image.
        dssim_weight: weight of 1 - SSIM, >= 0; at 0 no SSIM is computed.
        mask: the pixels that count, bool or 0 and 1, `(H, W)`, `(1, H, W)` or, one per image, `(B, 1, H, W)`: the
            first term is their mean, the second the mean over windows (11 x 11, smaller at the border) that lie wholly
            in the mask, 0 if there is none. Pixels outside get no gradient and may be NaN.
        fast: False uses Kornia's own operations, which have second derivatives.
        moments: `target_moments(target)` of this same target, to save that work. Only the fast path uses it.
        backend: "auto", "torch", "numba" or "triton". Kernels run the fast path without a mask; torch does the rest.

    Returns:
        The loss, 0-d.

    Raises:
        TypeError: an image is not a float32 or float64 tensor, the two differ in dtype or device, or `moments` is not a
            TargetMoments.
        ValueError: shapes do not match, the weight is out of range, the mask is empty or has values other than 0
            and 1, or the backend does not exist or does not cover the call.
        ModuleNotFoundError: the backend is numba or triton, and it is not installed.
        RuntimeError: from `backward(create_graph=True)` through the fast path, which has no second derivative.

    Examples:
        >>> target = torch.rand(1, 3, 32, 32)
        >>> float(photometric_loss(target, target)) < 1e-4
        True
    """
    _check_images(image, image)
    table = get_backend(backend, image.device).covering("loss", image)
    shape = (1, image.shape[0] * image.shape[1], *image.shape[-2:])
    moments = target if isinstance(target, TargetMoments) else moments
    if moments is not None and not isinstance(moments, TargetMoments):
        raise TypeError(f"moments: expected TargetMoments, got {type(moments).__name__}")
    if moments is not None and not _belong_to(moments, image):
        given = tuple(moments.padded.shape)
        raise ArgumentError("moments", f"those of a target like image, {tuple(image.shape)}", f"{given} padded")
    if isinstance(target, TargetMoments):
        target = target.padded[..., RADIUS:-RADIUS, RADIUS:-RADIUS].reshape(image.shape)
    _check_images(image, target)
    if not (math.isfinite(dssim_weight) and dssim_weight >= 0.0):
        raise ArgumentError("dssim_weight", "a finite number >= 0", dssim_weight)
    outside = None if mask is None else _outside(mask, image)
    if dssim_weight != 0.0 and min(shape[-2:]) <= RADIUS:
        raise ArgumentError("image", f"at least {RADIUS + 1} x {RADIUS + 1} pixels", f"{shape[-2]} x {shape[-1]}")
    fast = fast and not target.requires_grad
    if table.loss is None or not fast or outside is not None or dssim_weight == 0.0 or min(shape[-2:]) < WINDOW:
        return _torch_loss(image, target, moments, dssim_weight, outside, fast)
    moments = target_moments(target) if moments is None else moments
    keep = torch.is_grad_enabled() and image.requires_grad
    loss: Tensor = _PhotometricLoss.apply(image, target, moments.mean, moments.variance, dssim_weight, table, keep)[0]
    return loss


@torch.inference_mode(False)  # autograd could not save tensors made in inference mode
@torch.no_grad()
def target_moments(target: Tensor, *, backend: str | Backend = "torch") -> TargetMoments:
    """The part of the SSIM that depends only on the target, for :func:`photometric_loss`; it carries no gradient.

    Args:
        target: `(B, C, H, W)`, H, W >= 6 (else a ValueError), float32 or float64 (else a TypeError).
        backend: "torch", the bits of :func:`photometric_loss` without `moments`; "numba" or "auto" for targets that are
            used once: six times as fast where a kernel covers the call (float32 on a CPU, H, W >= 11).
    """
    _check_images(target, target)
    table = get_backend(backend, target.device).covering("loss", target)
    if min(target.shape[-2:]) <= RADIUS:
        raise ArgumentError("target", f"at least {RADIUS + 1} x {RADIUS + 1} pixels", tuple(target.shape))
    padded = F.pad(target.reshape(1, -1, *target.shape[-2:]), BORDER, mode="reflect")
    if table.local_moments is not None and min(target.shape[-2:]) >= WINDOW:
        return TargetMoments(padded, *table.local_moments(target, window_taps(target.dtype)))
    mean = _blur(padded)
    return TargetMoments(padded, mean, _blur(padded * padded).sub_(mean * mean))


def _belong_to(moments: TargetMoments, image: Tensor) -> bool:
    """Whether the moments have the size, dtype and device of the image."""
    batch, channels, height, width = image.shape
    shape = (1, batch * channels, height, width)
    padded = (1, batch * channels, height + 2 * RADIUS, width + 2 * RADIUS)
    shapes = (tuple(moments.padded.shape), tuple(moments.mean.shape), tuple(moments.variance.shape))
    kinds = {(x.dtype, x.device) for x in vars(moments).values()}
    return shapes == (padded, shape, shape) and kinds == {(image.dtype, image.device)}


def _torch_loss(
    image: Tensor,
    target: Tensor,
    moments: TargetMoments | None,
    dssim_weight: float,
    outside: Tensor | None,
    fast: bool,
) -> Tensor:
    """`photometric_loss` in torch, for every call; arguments are already checked."""
    if outside is not None:
        image = image.masked_fill(outside, 0.0)
        target = target.masked_fill(outside, 0.0)
    loss = _mean((image - target).abs(), outside)
    if dssim_weight == 0.0:
        return loss
    if outside is not None:  # from here on: the windows that touch a pixel outside
        padded = F.pad(outside.float(), BORDER, mode="reflect")
        outside = F.max_pool2d(F.max_pool2d(padded, (WINDOW, 1), 1), (1, WINDOW), 1) > 0
        if bool(outside.all()):
            return loss
    if not fast or image.dtype != torch.float32 or min(image.shape[-2:]) < WINDOW:
        return loss + 2.0 * dssim_weight * _mean(ssim_loss(image, target, WINDOW, reduction="none"), outside)
    moments = target_moments(target) if moments is None else moments
    outside = None if outside is None else outside.expand_as(image).reshape(moments.mean.shape)
    image = image.reshape(moments.mean.shape)
    keep = torch.is_grad_enabled() and image.requires_grad
    mean_ssim: Tensor = _MeanSsim.apply(image, moments.padded, moments.mean, moments.variance, outside, keep)[0]
    return loss + dssim_weight * (1.0 - mean_ssim)


class _PhotometricLoss(torch.autograd.Function):
    """The loss of a backend, followed by what it keeps for its gradient."""

    @staticmethod
    def forward(
        image: Tensor, target: Tensor, mean: Tensor, variance: Tensor, weight: float, table: Backend, keep: bool
    ) -> tuple[Tensor, ...]:
        assert table.loss is not None
        loss, kept = table.loss(image, target, mean, variance, window_taps(image.dtype), weight, keep)
        return loss, *kept

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        image, *_, ctx.weight, ctx.table, _ = inputs
        ctx.taps = window_taps(image.dtype)
        ctx.save_for_backward(*output[1:])
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: None) -> tuple[Tensor | None, ...]:
        _refuse_second_derivative()
        return ctx.table.loss_gradient(ctx.saved_tensors, ctx.taps, ctx.weight, grad), *[None] * 6


def _refuse_second_derivative() -> None:
    refuse_second_derivative("photometric_loss", "; pass fast=False")


class _MeanSsim(torch.autograd.Function):
    """Mean SSIM of an image `(1, K, H, W)` and a target given by its moments, over the windows that are not `outside`.

    Its derivatives by local mean, square and product with the target are pointwise; a blur takes them to the pixels.
    """

    @staticmethod
    def forward(
        image: Tensor, target: Tensor, mean_y: Tensor, variance_y: Tensor, outside: Tensor | None, keep: bool
    ) -> tuple[Tensor, ...]:
        padded = F.pad(image, BORDER, mode="reflect")
        mean = _blur(padded)
        mean_squared = mean * mean
        mean_product = mean * mean_y
        b = _blur(padded * target).sub_(mean_product).mul_(2.0).add_(C2)
        d = _blur(padded * padded).sub_(mean_squared).add_(variance_y).add_(C2)
        a = mean_product.mul_(2.0).add_(C1)
        c = mean_squared.addcmul_(mean_y, mean_y).add_(C1)
        inverse = (c * d).add_(EPS).reciprocal_()
        ssim = (a * b).mul_(inverse)
        kept: tuple[Tensor, ...] = ()
        if keep:
            # With r = 1 / (c d + eps): dS/da = b r, dS/db = a r, dS/dc = -S r d, dS/dd = -S r c. The local mean is in
            # all four (da = 2 m_y, db = -2 m_y, dc = 2 m_x, dd = -2 m_x), the product in b, the square in d.
            scaled = ssim * inverse
            by_square = c.mul_(scaled).neg_()
            by_mean = (b - a).mul_(inverse).mul_(mean_y)
            by_mean.sub_(d.mul_(scaled).add_(by_square).mul_(mean)).mul_(2.0)
            by_product = a.mul_(inverse).mul_(2.0)
            if outside is not None:
                for derivative in (by_mean, by_square, by_product):
                    derivative.masked_fill_(outside, 0.0)
            kept = (padded, by_mean, by_square, by_product)
        return _mean(ssim, outside).clamp_max(1.0), *kept

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        _, target, mean_y, _, outside, _ = inputs
        ctx.save_for_backward(target, *output[1:])
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)
        ctx.count = mean_y.numel() if outside is None else int((~outside).sum())

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: None) -> tuple[Tensor | None, ...]:
        _refuse_second_derivative()
        target, padded, by_mean, by_square, by_product = ctx.saved_tensors
        pixels = _blur_adjoint(by_mean).addcmul_(padded, _blur_adjoint(by_square), value=2.0)
        pixels.addcmul_(target, _blur_adjoint(by_product))
        return _fold(pixels).mul_(grad / ctx.count), *[None] * 5


def _mean(values: Tensor, outside: Tensor | None) -> Tensor:
    """The mean over the values that are not outside."""
    if outside is None:
        return values.mean()
    outside = outside.expand_as(values)
    return values.masked_fill(outside, 0.0).sum() / (~outside).sum()


def _outside(mask: Tensor, image: Tensor) -> Tensor:
    """The pixels that do not count, bool `(B, 1, H, W)`."""
    images = image.shape[0]
    size = tuple(image.shape[-2:])
    shape = tuple(mask.shape) if isinstance(mask, Tensor) else type(mask).__name__
    if shape not in (size, (1, *size), (1, 1, *size), (images, 1, *size)):
        raise ArgumentError("mask", f"shape {size}, {(1, *size)} or {(images, 1, *size)}", shape)
    outside = mask == 0
    if not bool((outside | (mask == 1)).all()):
        raise ArgumentError("mask", "True and False, or 0 and 1; for other values write mask > 0.5")
    if bool(outside.all()):
        raise ArgumentError("mask", "at least one pixel that counts", "none")
    return outside.expand(images, 1, *size)


def _fold(grad: Tensor) -> Tensor:
    """Adjoint of the reflected border. That of `F.pad` sums in no fixed order on CUDA."""
    for dim in (-1, -2):
        size = grad.shape[dim] - 2 * RADIUS
        before, inner, after = grad.split([RADIUS, size, RADIUS], dim)
        grad = inner.clone()
        grad.narrow(dim, 1, RADIUS).add_(before.flip(dim))
        grad.narrow(dim, size - RADIUS - 1, RADIUS).add_(after.flip(dim))
    return grad


def _blur(maps: Tensor) -> Tensor:
    """Window each map, `(..., H + 10, W + 10)` to `(..., H, W)`, by shifted sums: no TF32, no autocast."""
    weights = window_taps(maps.dtype)
    for dim in (-1, -2):
        size = maps.shape[dim] - 2 * RADIUS
        blurred = maps.narrow(dim, 0, size) * weights[0]
        for shift in range(1, WINDOW):
            blurred.add_(maps.narrow(dim, shift, size), alpha=weights[shift])
        maps = blurred
    return maps


@functools.cache
def window_taps(dtype: torch.dtype) -> list[float]:
    """Kornia's window along one axis."""
    taps: list[float] = get_gaussian_kernel1d(WINDOW, SIGMA, device=torch.device("cpu"), dtype=dtype).flatten().tolist()
    return taps


def _blur_adjoint(maps: Tensor) -> Tensor:
    """Transpose of `_blur`, whose window is symmetric: `(..., H, W)` to `(..., H + 10, W + 10)`."""
    return _blur(F.pad(maps, [2 * RADIUS] * 4))


def _check_images(image: Tensor, target: Tensor) -> None:
    """Raise a TypeError or ValueError unless these are two images of one shape, dtype and device."""
    for name, value in (("image", image), ("target", target)):
        if not isinstance(value, Tensor):
            raise TypeError(f"{name}: expected a torch.Tensor, got {type(value).__name__}")
        if value.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"{name}: expected float32 or float64, got {value.dtype}")
    if (target.dtype, target.device) != (image.dtype, image.device):
        expected = f"{image.dtype} on {image.device}"
        raise TypeError(f"target: expected {expected} as image, got {target.dtype} on {target.device}")
    if image.ndim != 4 or image.numel() == 0:
        raise ArgumentError("image", "shape (B, C, H, W), each at least 1", tuple(image.shape))
    if target.shape != image.shape:
        raise ArgumentError("target", f"shape {tuple(image.shape)} as image", tuple(target.shape))
