"""Scores of Gaussians: which ones a selective drop switches off, and which ones the L1 penalty holds down.

Source: "DropGaussian" (CVPR 2025) compares random dropping with a selection and a penalty "by gradient" and "by
distance" and defines none of them. These are this project's readings, in both directions.
"""

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.densify import Densifier
from kgs.drop import DropGaussian
from kgs.geometry import camera_centers


class SelectiveDrop(DropGaussian):
    """`DropGaussian` that drops the Gaussians with the highest `scores` where it has scores, and is random without.

    `scores` is a plain attribute: a tensor of the shape of the opacities that stays until it is replaced, or None. The
    call drops the share of the rate with the highest scores, of each camera's row in `(C, N)`, equal ones in order,
    and scales the rest by 1/(1 - rate). Unlike that of a random subset this render is no unbiased estimate.
    """

    scores: Tensor | None = None

    def forward(self, opacities: Tensor) -> Tensor:
        """Drop and rescale in `train()`, return `opacities` itself in `eval()`; scores have their shape."""
        scores, rate = self.scores, self.rate
        if not self.training or scores is None:
            return super().forward(opacities)
        if scores.shape != opacities.shape:
            raise ValueError(f"scores: expected shape {tuple(opacities.shape)}, got {tuple(scores.shape)}")
        if rate == 0.0:
            return opacities
        per_camera = scores.ndim > 1 and scores.shape[-1] > 1
        rows = scores.reshape(-1, scores.shape[-1]) if per_camera else scores.reshape(1, -1)
        dropped = rows.argsort(dim=1, descending=True, stable=True)[:, : round(rate * rows.shape[1])]
        mask = torch.full_like(rows, 1.0 / (1.0 - rate), dtype=opacities.dtype).scatter_(1, dropped, 0.0)
        return opacities * mask.reshape(opacities.shape)


def gaussian_scores(by: str, densifier: Densifier, camera: PinholeCamera) -> Tensor:
    """A number for each Gaussian, `(N,)`, the highest for those that `by` is about.

    "high-gradient" or "low-gradient": the mean gradient of the projected centre since the last densification. "far" or
    "near": the distance from the camera's centre, in world units.
    """
    scores, means = densifier.mean_gradients, densifier.model.means.detach()
    if not by.endswith("gradient"):
        scores = (means - camera_centers(camera.extrinsics).to(means)).norm(dim=1)
    return scores if by in ("high-gradient", "far") else -scores
