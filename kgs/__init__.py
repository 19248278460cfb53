"""Differentiable 3D Gaussian splatting for sparse views, in PyTorch and Kornia, with DropGaussian as a layer.

The method: `geometry` (Gaussians, cameras and the closed forms between them), `backends`, which compute with it, and
`drop` (the layer), `renderer`, `model`, `stages` (project, composite), `reference` (the dense renderer), `densify`,
`ply`, `compressed_ply`. `losses`, `datasets`, `init_points`, `fit` and `metrics` go from photos to a measured splat;
`gsplat` has gsplat's interface; `app` is the command.
"""

from ._support.errors import ArgumentError, DataError, TrainingDiverged
from ._support.lazy import TYPE_CHECKING, lazy_names
from ._support.version import __version__ as __version__
from ._support.wait_policy import wait_passively

if TYPE_CHECKING:
    from .compressed_ply import save_compressed_ply
    from .densify import Densifier, DensifyReport
    from .drop import DropGaussian, drop_gaussian
    from .geometry.cameras import PosedCamera, pinhole_cameras
    from .geometry.rigs import camera_extent
    from .geometry.types import Gaussians, ProjectedGaussians, RasterOptions, Rendering
    from .gsplat import rasterization
    from .model import GaussianModel
    from .ply import load_ply, save_ply
    from .renderer import GaussianRenderer
    from .stages import composite, project

__all__ = ["DropGaussian", "drop_gaussian", "GaussianRenderer", "rasterization", "project", "composite"]
__all__ += ["Gaussians", "ProjectedGaussians", "RasterOptions", "Rendering", "PosedCamera", "pinhole_cameras"]
__all__ += ["GaussianModel", "Densifier", "DensifyReport", "camera_extent", "save_ply", "load_ply"]
__all__ += ["save_compressed_ply"]
__all__ += ["ArgumentError", "DataError", "TrainingDiverged", "wait_passively"]

# so that the command `kgs` can answer before torch is loaded
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "kgs.cameras": (),
        "kgs.geometry.cameras": ("PosedCamera", "pinhole_cameras"),
        "kgs.compressed_ply": ("save_compressed_ply",),
        "kgs.densify": ("Densifier", "DensifyReport"),
        "kgs.drop": ("DropGaussian", "drop_gaussian"),
        "kgs.geometry.rigs": ("camera_extent",),
        "kgs.gsplat": ("rasterization",),
        "kgs.ply": ("load_ply", "save_ply"),
        "kgs.model": ("GaussianModel",),
        "kgs.renderer": ("GaussianRenderer",),
        "kgs.stages": ("composite", "project"),
        "kgs.geometry.types": ("Gaussians", "ProjectedGaussians", "RasterOptions", "Rendering"),
    },
)
