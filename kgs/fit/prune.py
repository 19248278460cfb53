"""Removes what the training views do not need: Gaussians that contribute next to nothing, and unused harmonics."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from kgs.camera import move_camera
from kgs.datasets.scene import Views
from kgs.metrics.evaluate import BEST
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer

from .trainer import Trainer

TOLERANCE = 0.01  # dB by which the PSNR of a training view may change
# Limits on what a Gaussian contributes to all training views together, in pixels; -1 keeps all.
WEIGHTS = (3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 0.0, -1.0)
QUANTUM = 0.5 / 255  # a smaller change of an 8-bit image is not visible


def prune(trainer: Trainer) -> None:
    """Show only what the training views need; the fit itself keeps everything. Does nothing with `keep_all`.

    Takes the highest limit of `WEIGHTS` that changes the PSNR of no training view by more than `TOLERANCE`, then the
    lowest degree of harmonics for which the same holds and which changes no pixel value by more than `QUANTUM`.

    Records "gaussians" in `trainer.needs`: how many were "fitted" and "kept", the limit "weight", and "sh_degree".
    """
    if trainer.config.keep_all:
        return
    model, views = trainer.model, trainer.scene.train
    weights = contributions(
        model, views, trainer.near_plane, max_bytes=trainer.config.max_bytes, backend=trainer.backend
    )
    trainer.show(weights >= WEIGHTS[-1], model.sh_degree)  # all, although an earlier call may have hidden some
    levels = _levels(trainer)
    for limit in WEIGHTS:
        rows = weights > limit
        trainer.show(rows, model.sh_degree)
        if _is_close(_levels(trainer), levels):
            break
    degree = _fewest_harmonics(trainer, rows, levels)
    kept = len(trainer.shown)
    trainer.record("gaussians", {"fitted": len(model), "kept": kept, "weight": limit, "sh_degree": degree})


def _fewest_harmonics(trainer: Trainer, rows: Tensor, levels: list[float]) -> int:
    """Show the Gaussians at `rows` with the lowest degree that changes no image; returns the degree."""
    most, views = trainer.model.sh_degree, trainer.scene.train
    images = [trainer.render(views.camera(i)) for i in range(len(views))] if most else []
    for degree in range(most + 1):
        trainer.show(rows, degree)
        renders = (trainer.render(views.camera(i)) for i in range(len(images)))
        same = all(bool(((now - before).abs() <= QUANTUM).all()) for now, before in zip(renders, images, strict=True))
        if same and _is_close(_levels(trainer), levels):
            break
    return degree


def _is_close(levels: list[float], others: list[float]) -> bool:
    return all(abs(level - other) <= TOLERANCE for level, other in zip(levels, others, strict=True))


def _levels(trainer: Trainer) -> list[float]:
    views = trainer.scene.train
    return [min(trainer.psnr(views.select([i])) or BEST, BEST) for i in range(len(views))]


def contributions(model: GaussianModel, views: Views, near_plane: float, **options: Any) -> Tensor:
    """The sum of each Gaussian's blending weights over the pixels of all views, `(N,)`.

    It is the gradient of the sum of all images with respect to the Gaussian's colour. `options` go to the renderer.
    """
    renderer = GaussianRenderer(near_plane=near_plane, antialiased=model.antialiased, **options).eval()
    with torch.no_grad():
        gaussians = model()
    colors = torch.zeros_like(gaussians.means).requires_grad_()
    for i in range(len(views)):
        camera = move_camera(views.camera(i), colors.device)
        renderer(replace(gaussians, colors=colors), camera).image[:, 0].sum().backward()
    return torch.zeros_like(colors[:, 0]) if colors.grad is None else colors.grad[:, 0]


def left_out(needs: dict[str, Any]) -> str:
    """What a fit left out, in words for the last line of its output; "" if that is nothing."""
    parts, harmonics, gaussians = [], needs.get("sh_degree"), needs.get("gaussians")
    if harmonics and harmonics["chosen"] == 0:
        why = harmonics.get("why", "by rule")
        if harmonics["by"] == "probes":
            why = f"{harmonics['gain']:+.2f} dB in {harmonics['n']} probes, noise {harmonics['noise']:.2f}"
        parts.append(f"harmonics ({why})")
    if gaussians and gaussians["kept"] < gaussians["fitted"]:
        share = 1 - gaussians["kept"] / gaussians["fitted"]
        parts.append(f"{100 * share:.0f} % of the Gaussians (next to no contribution to a training view)")
    return ", ".join(parts)
