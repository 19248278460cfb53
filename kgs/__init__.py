"""Differentiable 3D Gaussian splatting for sparse views, in PyTorch and Kornia, with DropGaussian as a layer."""

from .compositing import composite
from .drop import DropGaussian, drop_gaussian
from .errors import DataError, TrainingDiverged
from .projection import project
from .renderer import GaussianRenderer
from .tiles import bin_to_tiles
from .types import Gaussians, PosedCamera, ProjectedGaussians, Rendering, TileBins

__all__ = [
    "DropGaussian",
    "drop_gaussian",
    "GaussianRenderer",
    "project",
    "bin_to_tiles",
    "composite",
    "Gaussians",
    "PosedCamera",
    "ProjectedGaussians",
    "TileBins",
    "Rendering",
    "DataError",
    "TrainingDiverged",
]

__version__ = "0.1.0"
