"""What the paper compares random dropping with: dropping selected Gaussians, and an L1 penalty on opacities.

Source: "DropGaussian" (CVPR 2025) names a selection and a penalty "by gradient" and "by distance" and defines none of
them. These are this project's readings, in both directions.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.errors import ArgumentError
from kgs.datasets.scene import Scene
from kgs.densify import Densifier
from kgs.drop import DropGaussian
from kgs.fit.plan import Plan
from kgs.fit.targets import Target
from kgs.fit.trainer import Trainer
from kgs.geometry.rigs import camera_centers
from kgs.geometry.types import Gaussians, Rendering
from kgs.init_points import InitialPoints


@dataclass(frozen=True)
class Rival:
    """A rival of random dropping.

    Args:
        drop_by: which Gaussians are dropped: random ones, those with the highest or lowest mean gradient, those nearest
            to the camera or farthest from it.
        opacity_l1: weight of the L1 penalty on opacities; 0 leaves it out.
        opacity_l1_by: the penalty is heavier on Gaussians with a low mean gradient, or at a great distance.
    """

    drop_by: Literal["random", "high-gradient", "low-gradient", "near", "far"] = "random"
    opacity_l1: float = 0.0
    opacity_l1_by: Literal["gradient", "distance"] = "gradient"


class RivalTrainer(Trainer):
    """A `Trainer` that drops selected Gaussians or penalises opacities, as `rival` says."""

    def __init__(self, scene: Scene, plan: Plan, points: InitialPoints, rival: Rival) -> None:
        super().__init__(scene, plan, points)
        self.rival = rival
        self._penalty: Tensor | None = None
        drop = self.state.drop
        if drop is not None:
            self.state.drop = SelectiveDrop(drop.p, drop.schedule, seed=drop.seed)
            self.renderer.opacity_layer = self.state.drop

    def render_view(self, gaussians: Gaussians, camera: PinholeCamera, background: Tensor | None) -> Rendering:
        """Render with the scores of this camera; the penalty of its Gaussians is kept for the loss."""
        rival = self.rival
        densifier = self.state.densifier
        if isinstance(self.state.drop, SelectiveDrop) and rival.drop_by != "random":
            self.state.drop.scores = gaussian_scores(rival.drop_by, densifier, camera)
        if rival.opacity_l1:
            by = "low-gradient" if rival.opacity_l1_by == "gradient" else "far"
            scores = gaussian_scores(by, densifier, camera)
            self._penalty = rival.opacity_l1 * opacity_l1(gaussians.opacities, scores)
        return super().render_view(gaussians, camera, background)

    def loss_of(self, image: Tensor, view: Target) -> Tensor:
        """The loss of the render and, where the rival has it, the weighted L1 norm of the opacities."""
        loss = super().loss_of(image, view)
        return loss if self._penalty is None else loss + self._penalty


class SelectiveDrop(DropGaussian):
    """`DropGaussian` that drops the Gaussians with the highest `scores` where it has scores, and is random without.

    `scores` is a plain attribute: a tensor of the shape of the opacities that stays until it is replaced, or None. The
    call drops the share of the rate with the highest scores, of each camera's row in `(C, N)`, equal ones in order,
    and scales the rest by 1/(1 - rate). Unlike that of a random subset this render is not an unbiased estimate.
    """

    scores: Tensor | None = None

    def forward(self, opacities: Tensor) -> Tensor:
        """Drop and rescale in `train()`, return `opacities` itself in `eval()`; scores have their shape."""
        scores = self.scores
        if not self.training or scores is None:
            return super().forward(opacities)
        rate = float(self.rate)
        if scores.shape != opacities.shape:
            raise ArgumentError("scores", f"shape {tuple(opacities.shape)}", tuple(scores.shape))
        if rate == 0.0:
            return opacities
        per_camera = scores.ndim > 1 and scores.shape[-1] > 1
        rows = scores.reshape(-1, scores.shape[-1]) if per_camera else scores.reshape(1, -1)
        dropped = rows.argsort(dim=1, descending=True, stable=True)[:, : round(rate * rows.shape[1])]
        mask = torch.full_like(rows, 1.0 / (1.0 - rate), dtype=opacities.dtype).scatter_(1, dropped, 0.0)
        return opacities * mask.reshape(opacities.shape)


def gaussian_scores(by: str, densifier: Densifier, camera: PinholeCamera) -> Tensor:
    """A number for each Gaussian, `(N,)`, the highest for those that `by` is about.

    "high-gradient" or "low-gradient": :attr:`kgs.densify.Densifier.mean_gradients`. "far" or "near": the distance from
    the camera's centre, in world units.
    """
    if by.endswith("gradient"):
        scores = densifier.mean_gradients
    else:
        means = densifier.model.means.detach()
        scores = (means - camera_centers(camera.extrinsics).to(means)).norm(dim=1)
    return scores if by in ("high-gradient", "far") else -scores


def opacity_l1(opacities: Tensor, scores: Tensor) -> Tensor:
    """The mean of the opacities, each weighted by (rank - 1/2) / N with the rank of its score from 1 to N.

    Equal scores share the mean of their ranks. So the weights have mean 1/2 whatever the scores are, and nothing
    depends on the order of the Gaussians.

    Args:
        opacities: activated, in [0, 1], `(N,)` (else a ValueError); the gradient goes to these alone.
        scores: which Gaussians to penalise more, `(N,)` (else a ValueError), in any unit.

    Returns:
        A number in [0, 1]; 0 where there are no Gaussians.
    """
    if opacities.ndim != 1:
        raise ArgumentError("opacities", "shape (N,)", tuple(opacities.shape))
    if scores.shape != opacities.shape:
        raise ArgumentError("scores", f"shape {tuple(opacities.shape)}", tuple(scores.shape))
    ordered = scores.detach().sort().values
    below, not_above = (torch.searchsorted(ordered, scores.detach(), right=right) for right in (False, True))
    weights = (below + not_above).to(opacities.dtype) / (2 * max(len(scores), 1))
    return (weights * opacities).sum() / max(len(opacities), 1)
