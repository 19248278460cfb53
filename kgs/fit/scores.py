"""Scores of Gaussians: which ones a selective drop switches off, and which ones the L1 penalty holds down.

Source: "DropGaussian" (CVPR 2025) compares random dropping with a selection and a penalty "by gradient" and "by
distance" and defines none of them. These are this project's readings, in both directions.
"""

from __future__ import annotations

from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.densify import Densifier

from .starts.triangulate import camera_centers

__all__ = ["gaussian_scores"]


def gaussian_scores(by: str, densifier: Densifier, camera: PinholeCamera) -> Tensor:
    """A number for each Gaussian, `(N,)`, the highest for those that `by` is about.

    Args:
        by: "high-gradient" or "low-gradient": the mean gradient of the projected centre since the last densification.
            "far" or "near": the distance from the camera's centre, in world units.
        densifier: holds the Gaussians and what was observed of them.
        camera: of the present step.
    """
    if by in ("high-gradient", "low-gradient"):
        gradients = densifier.mean_gradients
        return gradients if by == "high-gradient" else -gradients
    means = densifier.model.means.detach()
    distances: Tensor = (means - camera_centers(camera).to(means)).norm(dim=1)
    return distances if by == "far" else -distances
