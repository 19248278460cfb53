"""What a fitted splat can do without: Gaussians that no training view shows, and harmonics that no picture shows."""

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

TOLERANCE = 0.01  # decibels by which the PSNR of a training view may change
WEIGHTS = (3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 0.0, -1.0)  # pixels that a Gaussian covers in all training views; -1: all
QUANTUM = 0.5 / 255  # what an 8-bit picture does not show


def prune(trainer: Trainer) -> None:
    """Show only what the training views need; the fit itself keeps everything. Nothing is done with `keep_all`.

    Of the limits in `WEIGHTS` the highest is taken that changes the PSNR of no training view by more than `TOLERANCE`,
    and of the degrees of harmonics the lowest of which that holds too, and that changes no value of the pictures by
    more than `QUANTUM`.

    It records "gaussians" in `trainer.needs`: how many were "fitted" and "kept", the limit "weight", and "sh_degree".
    """
    if trainer.config.keep_all:
        return
    model, views = trainer.model, trainer.scene.train
    rules: dict[str, Any] = {"max_bytes": trainer.config.max_bytes, "backend": trainer.backend}
    weights = contributions(model, views, trainer.near_plane, **rules)
    trainer.show(weights >= WEIGHTS[-1], model.sh_degree)  # also where a part was shown, of a fit that was done before
    levels = _levels(trainer)
    for limit in WEIGHTS:
        rows = weights > limit
        trainer.show(rows, model.sh_degree)
        if _is_close(_levels(trainer), levels):
            break
    degree, pictures = 0, [trainer.render(views.camera(i)) for i in range(len(views))] if model.sh_degree else []
    for degree in range(model.sh_degree + 1):
        trainer.show(rows, degree)
        renders = (trainer.render(views.camera(i)) for i in range(len(pictures)))
        same = all(bool(((now - whole).abs() <= QUANTUM).all()) for now, whole in zip(renders, pictures, strict=True))
        if same and _is_close(_levels(trainer), levels):
            break
    found = {"fitted": len(model), "kept": len(trainer.shown), "weight": limit, "sh_degree": degree}
    trainer.record("gaussians", found)


def _is_close(levels: list[float], others: list[float]) -> bool:
    return all(abs(level - other) <= TOLERANCE for level, other in zip(levels, others, strict=True))


def _levels(trainer: Trainer) -> list[float]:
    views = trainer.scene.train
    return [min(trainer.psnr(views.select([i])) or BEST, BEST) for i in range(len(views))]


def contributions(model: GaussianModel, views: Views, near_plane: float, **rules: Any) -> Tensor:
    """The sum of each Gaussian's blending weights over the pixels of all views, `(N,)`.

    It is the gradient of the pictures' sum by a colour of its own. `rules` are those of the renderer.
    """
    renderer = GaussianRenderer(near_plane=near_plane, **rules).eval()
    with torch.no_grad():
        gaussians = model()
    colors = torch.zeros_like(gaussians.means).requires_grad_()
    for i in range(len(views)):
        camera = move_camera(views.camera(i), colors.device)
        renderer(replace(gaussians, colors=colors), camera).image[:, 0].sum().backward()
    return torch.zeros_like(colors[:, 0]) if colors.grad is None else colors.grad[:, 0]


def left_out(needs: dict[str, Any]) -> str:
    """What a fit left out, for its last line; "" where that is nothing."""
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
