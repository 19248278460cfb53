"""Differentiable 3D Gaussian splatting for sparse views, in PyTorch and Kornia, with DropGaussian as a layer."""

import os
import sys

if "torch" not in sys.modules and "GOMP_SPINCOUNT" not in os.environ:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read when torch is loaded: threads that wait yield their core

from .camera import PosedCamera, cameras
from .densify import Densifier, DensifyReport
from .drop import DropGaussian, drop_gaussian
from .errors import DataError, TrainingDiverged
from .geometry import camera_extent
from .io.ply import load_ply, save_ply
from .model import GaussianModel
from .rasterization import rasterization
from .renderer import GaussianRenderer
from .stages import composite, project
from .types import Gaussians, ProjectedGaussians, RasterOptions, Rendering

__all__ = ["DropGaussian", "drop_gaussian", "GaussianRenderer", "rasterization", "project", "composite"]
__all__ += ["Gaussians", "ProjectedGaussians", "RasterOptions", "Rendering", "PosedCamera", "cameras"]
__all__ += ["GaussianModel", "Densifier", "DensifyReport", "camera_extent", "save_ply", "load_ply"]
__all__ += ["DataError", "TrainingDiverged"]

__version__ = "0.1.0"
