"""How far a backend is from torch on a small scene: whether "auto" trusts it, and what `kgs check` shows."""

from dataclasses import dataclass, replace

import torch
from kornia.filters import gaussian_blur2d, get_gaussian_kernel1d
from kornia.losses import ssim_loss
from torch import Tensor

from kgs.geometry.cameras import image_size, pinhole_cameras
from kgs.geometry.types import Gaussians, RasterOptions

from .signatures import AdamUpdate
from .table import TORCH, Backend

BOUND = 5e-5  # a larger disagreement is no rounding
_WINDOW, _SIGMA, _WEIGHT = 11, 1.5, 0.2  # of the loss
_BETAS, _ADAM_EPS, _LR, _STEPS = (0.9, 0.999), 1e-15, 0.01, 3.0  # of Adam
# thresholds: a layer that counts for one backend alone must not matter
_OPTIONS = RasterOptions(tile_size=8, alpha_threshold=1e-6, transmittance_stop=1e-5)


@dataclass(frozen=True)
class CheckCase:
    """What a training step asks of a backend.

    Args:
        cameras: how many see the Gaussians.
        bands: of the harmonics, `(degree + 1)^2`.
        depths: whether depths and their squares are composited, too.
        absgrad: whether absolute values of gradients are summed, too.
        poses: whether poses and intrinsics have gradients.
    """

    cameras: int = 1
    bands: int = 16
    depths: bool = False
    absgrad: bool = False
    poses: bool = False


EVERYTHING = CheckCase(cameras=2, depths=True, poses=True)
# of fits, as they begin and as they end
FITS = (CheckCase(absgrad=True), CheckCase(bands=1), CheckCase(bands=1, poses=True))


@torch.inference_mode(False)
@torch.enable_grad()
def largest_error(backend: Backend, device: torch.device, cases: tuple[CheckCase, ...] = (EVERYTHING,)) -> float:
    """The largest difference from torch in float64, over the largest value of its kind.

    Of training steps of 32 Gaussians, among them an opaque stack: activations, images with and without a background,
    the loss, all gradients that are asked for, and what an optimizer does with gradients.

    Args:
        backend: works in float32 on the device.
        device: where; torch is on the CPU where it has no float64 there.
        cases: what is done.
    """
    backend.compile_ahead(lambda of_cpu: run_stages(backend, of_cpu, cases), device)
    reference_device = device if device.type in ("cpu", "cuda") else torch.device("cpu")
    found = run_stages(backend, device, cases)
    exact = _pictured(TORCH, reference_device, cases)
    if backend.loss is not None:
        exact += _exact_loss()
    if backend.adam_step is not None:
        exact += _exactly_optimized()
    return max(_relative(value, expected) for value, expected in zip(found, exact, strict=True))


def run_stages(backend: Backend, device: torch.device, cases: tuple[CheckCase, ...]) -> list[Tensor]:
    """What a backend finds."""
    found = _pictured(backend, device, cases)
    if backend.loss is not None:
        found += _loss(backend, device)
    if backend.adam_step is not None:
        found += _optimized(backend, device)
    return found


def _pictured(backend: Backend, device: torch.device, cases: tuple[CheckCase, ...]) -> list[Tensor]:
    """What the stages of every backend find."""
    found = _blend(backend, device)
    for case in cases:
        found += _activate(backend, device, case)
        found += _render(backend, device, case)
    return found


def _random(*shape: int, low: float = -1.0, high: float = 1.0, seed: int = 0) -> Tensor:
    """Numbers of float32 in float64, so that both backends start from the same."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(shape, generator=generator, dtype=torch.float32, device="cpu")
    return (unit * (high - low) + low).double()


def _dtype(backend: Backend) -> torch.dtype:
    """Float64 of torch, which defines what is right."""
    return torch.float64 if backend is TORCH else torch.float32


def _activate(backend: Backend, device: torch.device, case: CheckCase) -> list[Tensor]:
    """Scales, opacities and harmonics, and the gradients of what they are made of."""
    rest = _random(8, case.bands - 1, 3, seed=1)
    values = (_random(8, 3, low=-8.0), _random(8, low=-8.0, high=8.0), _random(8, 1, 3), rest)
    leaves = [x.to(device, _dtype(backend)).requires_grad_() for x in values]
    log_scales, opacity_logits, sh_dc, sh_rest = leaves
    activated = backend.activate(log_scales, opacity_logits, sh_dc, sh_rest, case.bands)
    weights = [_random(*x.shape, seed=2).to(x) for x in activated]
    used = leaves if case.bands > 1 else leaves[:3]
    return [*activated, *torch.autograd.grad(activated, used, weights)]


def _blend(backend: Backend, device: torch.device) -> list[Tensor]:
    """Images over a colour, and the gradients of images and transmittance."""
    values = (_random(2, 5, 6, 7), _random(2, 1, 6, 7, low=0.0, seed=1))
    leaves = [x.to(device, _dtype(backend)).requires_grad_() for x in values]
    image, transmittance = leaves
    blended = backend.blend(image, transmittance, _random(5, 1, 1).to(image))
    return [blended, *torch.autograd.grad(blended, leaves, _random(2, 5, 6, 7, seed=2).to(blended))]


def _render(backend: Backend, device: torch.device, case: CheckCase) -> list[Tensor]:
    """Images, once with what gradients need and once without, and gradients."""
    dtype = _dtype(backend)
    n = 32
    width, height = 16, 12
    means = (_random(n, 3) + torch.tensor([0.0, 0.0, 3.0], device="cpu")).float()
    scales = _random(n, 3, low=0.02, high=0.25, seed=1)
    opacities = _random(n, low=0.1, seed=2)
    # a stack of opaque Gaussians on one ray
    means[:8] = torch.tensor([0.3, -0.2, 2.5], device="cpu") * torch.linspace(1.0, 1.4, 8, device="cpu")[:, None]
    scales[:8] = 0.15
    opacities[:8] = 5.0
    values = (means, _random(n, 4, seed=3), scales, opacities, _random(n, 16, 3, seed=4)[:, : case.bands])
    poses = torch.eye(4, device="cpu").repeat(2, 1, 1)
    poses[1, 0, 3] = 0.2
    focal = torch.tensor([[15.0, 0.0, 7.5], [0.0, 15.0, 5.5], [0.0, 0.0, 1.0]], device="cpu").repeat(2, 1, 1)
    leaves = [x.to(device, dtype).requires_grad_() for x in values]
    extrinsics, intrinsics = (x[: case.cameras].to(device, dtype).requires_grad_(case.poses) for x in (poses, focal))
    camera = pinhole_cameras(extrinsics, intrinsics, width, height)
    varying = [*leaves, extrinsics, intrinsics] if case.poses else leaves
    options = replace(_OPTIONS, absgrad=case.absgrad)
    projected = backend.project(Gaussians(*leaves), camera, image_size(camera), options, True)
    features = projected.colors
    if case.depths:
        depths = projected.depths[:, None]
        features = torch.cat([features, depths, depths.square()], 1)
    inputs = (projected.means2d, projected.factors, projected.opacities, features)
    with torch.no_grad():
        compositor = backend.compositor(projected, features, options)
        sums, transmittance, _ = compositor.forward(inputs, True)
        by_sums, by_transmittance = (_random(*x.shape, seed=5).to(device, dtype) for x in (sums, transmittance))
        gradients, absolute = compositor.backward(inputs, by_sums, by_transmittance, (True,) * 4)
        drawn, behind, _ = compositor.forward(inputs, False)
    images = [sums, transmittance, drawn, behind, *([] if absolute is None else [absolute])]
    return images + list(torch.autograd.grad(inputs, varying, gradients))


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
    assert backend.loss
    assert backend.loss_gradient
    loss, kept = backend.loss(x, y, mean, variance, taps, _WEIGHT, True)
    return loss, backend.loss_gradient(kept, taps, _WEIGHT, torch.ones_like(loss))


def _exact_loss() -> tuple[Tensor, Tensor]:
    """The same by Kornia."""
    image, target = _pictures()
    image = image.requires_grad_()
    loss = (image - target).abs().mean() + 2 * _WEIGHT * ssim_loss(image, target, _WINDOW)
    return loss, torch.autograd.grad(loss, image)[0]


def _parameters() -> list[Tensor]:
    """A parameter, its gradient, and its moments."""
    gradient, average, square = (_random(40, 3, seed=seed) for seed in (9, 10, 11))
    return [_random(40, 3, seed=8), gradient, average, square.abs()]


def _optimized(backend: Backend, device: torch.device) -> list[Tensor]:
    """What is left of a step of Adam for six parameters, of statistics of densification, and of a decay of logits."""
    updates = []
    for _ in range(6):
        parameter, gradient, average, square = (x.to(device, torch.float32) for x in _parameters())
        updates.append(AdamUpdate(parameter, gradient, average, square, _LR, _STEPS))
    assert backend.adam_step
    assert backend.add_gradient_norms
    assert backend.decay_opacity
    backend.adam_step(updates, _BETAS, _ADAM_EPS)
    logits = _parameters()[-1][:, 0].to(device, torch.float32).contiguous()
    sums, counts = logits.clone(), torch.zeros(40, dtype=torch.int64, device=device)
    ids = torch.arange(0, 40, 2, device=device)
    backend.add_gradient_norms(sums, counts, ids, gradient[:20, :2].contiguous(), (0.5, 2.0))
    backend.decay_opacity(logits, 0.9)
    return [updates[-1].parameter, updates[0].exp_avg, updates[0].exp_avg_sq, sums, counts, logits]


def _exactly_optimized() -> list[Tensor]:
    """The same by its formulas."""
    parameter, gradient, average, square = _parameters()
    beta1, beta2 = _BETAS
    logits = square[:, 0]
    norms, counts = torch.zeros_like(logits), torch.zeros_like(logits)
    norms[::2] = (gradient[:20, :2] * torch.tensor([0.5, 2.0], device="cpu")).norm(dim=1)
    counts[::2] = 1.0
    average = beta1 * average + (1.0 - beta1) * gradient
    square = beta2 * square + (1.0 - beta2) * gradient.square()
    root = (square / (1.0 - beta2**_STEPS)).sqrt() + _ADAM_EPS
    parameter = parameter - _LR / (1.0 - beta1**_STEPS) * average / root
    return [parameter, average, square, logits + norms, counts, (0.9 * logits.sigmoid()).logit()]


def _relative(value: Tensor, expected: Tensor) -> float:
    """The largest difference over the largest value; infinite where something is not a number."""
    expected = expected.detach().cpu()
    worst = float((value.detach().cpu() - expected).abs().max() / expected.abs().max())
    return worst if worst == worst else float("inf")
