"""Differentiable 3D Gaussian splatting for sparse views, in PyTorch and Kornia, with DropGaussian as a layer."""

import os
import sys
from importlib import import_module

if "torch" not in sys.modules and "GOMP_SPINCOUNT" not in os.environ:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read when torch is loaded: threads that wait yield their core

from .errors import DataError, TrainingDiverged

TYPE_CHECKING = False  # type checkers take it as True; importing `typing` would cost more than all the rest here
if TYPE_CHECKING:
    from typing import Any

    from .camera import PosedCamera, pinhole_cameras
    from .densify import Densifier, DensifyReport
    from .drop import DropGaussian, drop_gaussian
    from .geometry import camera_extent
    from .gsplat import rasterization
    from .io.ply import load_ply, save_ply
    from .model import GaussianModel
    from .renderer import GaussianRenderer
    from .stages import composite, project
    from .types import Gaussians, ProjectedGaussians, RasterOptions, Rendering

__all__ = ["DropGaussian", "drop_gaussian", "GaussianRenderer", "rasterization", "project", "composite"]
__all__ += ["Gaussians", "ProjectedGaussians", "RasterOptions", "Rendering", "PosedCamera", "pinhole_cameras"]
__all__ += ["GaussianModel", "Densifier", "DensifyReport", "camera_extent", "save_ply", "load_ply"]
__all__ += ["DataError", "TrainingDiverged"]

__version__ = "0.1.0"

_HOMES = {
    "PosedCamera": "camera",
    "pinhole_cameras": "camera",
    "Densifier": "densify",
    "DensifyReport": "densify",
    "DropGaussian": "drop",
    "drop_gaussian": "drop",
    "rasterization": "gsplat",
    "GaussianModel": "model",
    "load_ply": "io.ply",
    "save_ply": "io.ply",
    "project": "stages",
    "composite": "stages",
    "GaussianRenderer": "renderer",
    "camera_extent": "geometry",
    "Gaussians": "types",
    "ProjectedGaussians": "types",
    "RasterOptions": "types",
    "Rendering": "types",
}


def __getattr__(name: str) -> "Any":
    """Load a public name, and torch with it, on first use, so that the command `kgs` can answer before that."""
    if name in _HOMES:
        value = getattr(import_module(f".{_HOMES[name]}", __name__), name)
    elif name in _HOMES.values():
        value = import_module(f".{name}", __name__)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
