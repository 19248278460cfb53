"""Differentiable 3D Gaussian splatting for sparse views, in PyTorch and Kornia, with DropGaussian as a layer."""

from .drop import DropGaussian, drop_gaussian
from .errors import DataError, TrainingDiverged
from .types import Gaussians, PosedCamera, ProjectedGaussians, Rendering, TileBins

__all__ = [
    "DropGaussian",
    "drop_gaussian",
    "Gaussians",
    "PosedCamera",
    "ProjectedGaussians",
    "TileBins",
    "Rendering",
    "DataError",
    "TrainingDiverged",
]

__version__ = "0.1.0"
