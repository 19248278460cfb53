"""How far a backend is from torch on a small scene: whether "auto" trusts it, and what `kgs check` shows."""

import torch
from kornia.filters import gaussian_blur2d, get_gaussian_kernel1d
from kornia.losses import ssim_loss
from torch import Tensor

from kgs.camera import image_size, pinhole_cameras
from kgs.types import Gaussians, RasterOptions

from .base import AdamUpdate, Backend, CompositingCall, CompositingInputs
from .torch import TorchBackend

BOUND = 5e-5  # a larger disagreement is no rounding
_WINDOW, _SIGMA, _WEIGHT = 11, 1.5, 0.2  # of the loss
_RATE, _STEP, _BETAS, _EPS = 0.01, 3.0, (0.9, 0.999), 1e-8  # of Adam
_SCALE, _FACTOR = (25.0, 15.0), 0.9  # of gradients, of opacities
# thresholds: a layer that counts for one backend alone must not matter
_OPTIONS = RasterOptions(tile_size=8, alpha_threshold=1e-6, transmittance_stop=1e-5)


@torch.inference_mode(False)
@torch.enable_grad()
def disagreement(backend: Backend, device: torch.device) -> float:
    """The largest difference from torch in float64, over the largest value of its kind.

    Of a training step of 32 Gaussians before two cameras: harmonics of degree 3, a stack of opaque Gaussians, five
    features, the loss; the gradients of all Gaussians, of poses and intrinsics, and of the image. And of what an
    optimizer does with gradients.

    Args:
        backend: works in float32 on the device.
        device: where; torch is on the CPU where it has no float64 there.
    """
    reference_device = device if device.type in ("cpu", "cuda") else torch.device("cpu")
    pairs = list(zip(_render(backend, device), _render(TorchBackend(), reference_device), strict=True))
    if backend.has_loss:
        pairs += zip(_loss(backend, device), _exact_loss(), strict=True)
    if backend.has_optimizer:
        pairs += zip(_optimized(backend, device), _exactly_optimized(), strict=True)
    return max(_relative(value, expected) for value, expected in pairs)


def _random(*shape: int, low: float = -1.0, high: float = 1.0, seed: int = 0) -> Tensor:
    """Numbers of float32 in float64, so that both backends start from the same."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(shape, generator=generator, dtype=torch.float32, device="cpu")
    return (unit * (high - low) + low).double()


def _render(backend: Backend, device: torch.device) -> list[Tensor]:
    """Image, depth and transmittance, and the gradients of all inputs; float64 from torch, else float32."""
    dtype = torch.float64 if isinstance(backend, TorchBackend) else torch.float32
    n = 32
    width, height = 16, 12
    means = (_random(n, 3) + torch.tensor([0.0, 0.0, 3.0], device="cpu")).float()
    scales = _random(n, 3, low=0.02, high=0.25, seed=1)
    opacities = _random(n, low=0.1, seed=2)
    # a stack of opaque Gaussians on one ray
    means[:8] = torch.tensor([0.3, -0.2, 2.5], device="cpu") * torch.linspace(1.0, 1.4, 8, device="cpu")[:, None]
    scales[:8] = 0.15
    opacities[:8] = 5.0
    poses = torch.eye(4, device="cpu").repeat(2, 1, 1)
    poses[1, 0, 3] = 0.2
    values = (means, _random(n, 4, seed=3), scales, opacities, _random(n, 16, 3, seed=4), poses)
    focal = torch.tensor([[15.0, 0.0, 7.5], [0.0, 15.0, 5.5], [0.0, 0.0, 1.0]], device="cpu").repeat(2, 1, 1)
    leaves = [x.to(device, dtype).requires_grad_() for x in (*values, focal)]
    camera = pinhole_cameras(leaves[5], leaves[6], width, height)
    projected = backend.project(Gaussians(*leaves[:5]), camera, image_size(camera), _OPTIONS, True)
    depths = projected.depths[:, None]
    features = torch.cat([projected.colors, depths, depths.square()], 1)
    inputs = CompositingInputs(projected.means2d, projected.factors, projected.opacities, features)
    with torch.no_grad():
        compositor = backend.compositor(CompositingCall(projected, features, _OPTIONS))
        (sums, transmittance, _), kept = compositor.forward(inputs, True)
        by_sums, by_transmittance = (_random(*x.shape, seed=5).to(device, dtype) for x in (sums, transmittance))
        gradients, _ = compositor.backward(inputs, kept, by_sums, by_transmittance, (True,) * 4)
    return [sums, transmittance, *torch.autograd.grad(inputs, leaves, gradients)]


def _pictures() -> tuple[Tensor, Tensor]:
    """An image and a target."""
    return _random(1, 3, 16, 20, low=0.0, seed=6), _random(1, 3, 16, 20, low=0.0, seed=7)


def _loss(backend: Backend, device: torch.device) -> tuple[Tensor, Tensor]:
    """The loss of a backend and its gradient."""
    image, target = _pictures()
    mean, square = (gaussian_blur2d(x, (_WINDOW, _WINDOW), (_SIGMA, _SIGMA)) for x in (target, target * target))
    x, y, mean, variance = (each.to(device, torch.float32) for each in (image, target, mean, square - mean * mean))
    window = get_gaussian_kernel1d(_WINDOW, _SIGMA, device=torch.device("cpu"), dtype=torch.float32)
    taps: list[float] = window.flatten().tolist()
    loss, gradient = backend.loss_and_gradient(x, y, mean, variance, taps, _WEIGHT, True)
    assert gradient is not None
    return loss, gradient


def _exact_loss() -> tuple[Tensor, Tensor]:
    """The same by Kornia."""
    image, target = _pictures()
    image = image.requires_grad_()
    loss = (image - target).abs().mean() + 2 * _WEIGHT * ssim_loss(image, target, _WINDOW)
    return loss, torch.autograd.grad(loss, image)[0]


def _before() -> tuple[Tensor, ...]:
    """Parameters, gradients, both moments, sums of norms, logits."""
    return _random(40), _random(40, seed=1), _random(40, seed=2), _random(40, low=0.0, seed=3), _random(20), _random(20)


def _optimized(backend: Backend, device: torch.device) -> list[Tensor]:
    """What the stages of an optimizer change: parameters and moments, sums and counts, logits."""
    *update, sums, logits = (x.to(device, torch.float32) for x in _before())
    parameter, gradient, exp_avg, exp_avg_sq = update
    counts = torch.zeros(20, dtype=torch.int64, device=device)
    ids = torch.arange(19, -1, -1, device=device)
    stages = backend.optimizer
    stages.adam([AdamUpdate(parameter, gradient, exp_avg, exp_avg_sq, _RATE, _STEP)], _BETAS, _EPS)
    stages.add_gradient_norms(sums, counts, ids, gradient.view(20, 2), _SCALE)
    stages.decay_opacity(logits, _FACTOR)
    return [parameter, exp_avg, exp_avg_sq, sums, counts, logits]


def _exactly_optimized() -> list[Tensor]:
    """The same by the formulas."""
    parameter, gradient, exp_avg, exp_avg_sq, sums, logits = _before()
    (beta1, beta2), (x, y) = _BETAS, torch.tensor(_SCALE, device="cpu")
    exp_avg = beta1 * exp_avg + (1 - beta1) * gradient
    exp_avg_sq = beta2 * exp_avg_sq + (1 - beta2) * gradient.square()
    root = (exp_avg_sq / (1 - beta2**_STEP)).sqrt() + _EPS
    parameter = parameter - _RATE * exp_avg / (1 - beta1**_STEP) / root
    norms = torch.hypot(gradient[::2] * x, gradient[1::2] * y).flip(0)
    decayed = (_FACTOR * logits.sigmoid()).logit()
    return [parameter, exp_avg, exp_avg_sq, sums + norms, torch.ones_like(sums), decayed]


def _relative(value: Tensor, expected: Tensor) -> float:
    """The largest difference over the largest value; infinite where something is not a number."""
    expected = expected.detach().cpu()
    worst = float((value.detach().cpu() - expected).abs().max() / expected.abs().max())
    return worst if worst == worst else float("inf")
