"""Removes what the training views do not need: Gaussians that contribute next to nothing, and unused harmonics."""

from dataclasses import replace

import torch
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.geometry.cameras import to
from kgs.geometry.types import RasterOptions
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer

from .decisions import Decisions, PruningDecision
from .fit import Fit
from .view_renders import ViewRenders

TOLERANCE = 0.01  # dB by which the PSNR of a training view may change
# Limits on what a Gaussian contributes to all training views together, in pixels; -1 keeps all.
WEIGHTS = (3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 0.0, -1.0)
QUANTUM = 0.5 / 255  # a smaller change of an 8-bit image is not visible


def prune(fit: Fit) -> Fit:
    """The fit with what the training views need, or the same one where its settings keep all.

    Takes the highest limit of `WEIGHTS` that changes the PSNR of no training view by more than `TOLERANCE`, then the
    lowest degree of harmonics for which the same holds and which changes no pixel value by more than `QUANTUM`.

    `decisions.gaussians` of the pruned fit says how many were kept.

    Args:
        fit: a fit that is done.
    """
    if fit.settings is not None and not fit.settings.prune:
        return fit
    model = fit.model
    weights = contributions(model, fit.scene.train, fit.options, fit.backend)
    levels = psnr_per_view(fit)
    for limit in WEIGHTS:
        rows = weights > limit
        pruned = _part(fit, rows, model.sh_degree)
        if _keeps_psnr(pruned, levels):
            break
    pruned = _with_lowest_degree(fit, pruned, levels)
    kept = PruningDecision(len(model), len(pruned.model), limit, pruned.part["sh_degree"])
    return pruned.annotated(decisions=replace(fit.decisions, gaussians=kept))


def _part(fit: Fit, rows: Tensor, sh_degree: int) -> Fit:
    """The fit with only the Gaussians at `rows`, bool `(N,)`, at this degree."""
    part = {"rows": rows.cpu(), "sh_degree": sh_degree}
    return replace(fit, model=fit.model.select(rows, sh_degree), part=part)


def _with_lowest_degree(fit: Fit, pruned: Fit, levels: list[float]) -> Fit:
    """The pruned fit with the lowest degree that changes no image."""
    rows = pruned.part["rows"].to(fit.device)
    for degree in range(fit.model.sh_degree):
        lower = _part(fit, rows, degree)
        pairs = zip(lower.train_renders.images, pruned.train_renders.images, strict=True)
        if all(bool(((one - other).abs() <= QUANTUM).all()) for one, other in pairs) and _keeps_psnr(lower, levels):
            return lower
    return pruned


def _keeps_psnr(fit: Fit, levels: list[float]) -> bool:
    """Whether each training view has its former PSNR, to `TOLERANCE`."""
    renders = fit.train_renders  # each made when it is asked for: none after the first that differs
    return all(abs(level - before) <= TOLERANCE for level, before in zip(renders.psnr_per_view, levels, strict=True))


def psnr_per_view(fit: Fit) -> list[float]:
    """The PSNR of each training view in dB, of the model as it is, with `kgs.metrics.evaluate.BEST` for infinity."""
    return [*ViewRenders(fit.scene.train, fit.render_with_depth).psnr_per_view]


def contributions(model: GaussianModel, views: Views, options: RasterOptions, backend: str = "auto") -> Tensor:
    """The sum of each Gaussian's blending weights over the pixels of all views, `(N,)`.

    It is the gradient of the sum of all images with respect to the Gaussian's colour.
    """
    renderer = GaussianRenderer(options=options, backend=backend).eval()
    with torch.no_grad():
        gaussians = model(backend=backend)
    colors = torch.zeros_like(gaussians.means).requires_grad_()
    for i in range(len(views)):
        camera = to(views.camera(i), colors.device)
        renderer(replace(gaussians, colors=colors), camera).image[:, 0].sum().backward()
    return torch.zeros_like(colors[:, 0]) if colors.grad is None else colors.grad[:, 0]


def left_out(decisions: Decisions) -> str:
    """What a fit left out and why, in words for its output and its page, or ""."""
    parts = []
    degree = decisions.sh_degree
    if degree is not None and degree.chosen == 0:
        why = degree.why if degree.gain is None else f"harmonics could add at most {degree.gain:.2f} dB"
        parts.append(f"each colour is the same from all directions: {why or 'by rule'}")
    overlap = decisions.overlap
    if overlap is not None and overlap.drop == 0:
        parts.append(f"DropGaussian is off: each point is seen by {overlap.views_per_patch:.1f} photos on average")
    gaussians = decisions.gaussians
    share = 0.0 if gaussians is None else 1 - gaussians.kept / max(gaussians.fitted, 1)
    if share >= 0.005:
        parts.append(f"{100 * share:.0f} % of the Gaussians are removed: no photo needs them")
    return "; ".join(parts)
