"""The backend in plain torch: every call, device and dtype; the reference for the others."""

from torch import Tensor

from kgs.camera import Cameras
from kgs.projection import project_torch
from kgs.raster.compositing import TorchCompositing
from kgs.types import Gaussians, ProjectedGaussians, RasterOptions

from .base import Backend, Compositor


class TorchBackend(Backend):
    """The vectorised rasteriser of `kgs.projection` and `kgs.raster`."""

    name = "torch"

    def covers(self, like: Tensor) -> bool:
        """Every call."""
        return True

    def project(
        self, gaussians: Gaussians, cameras: Cameras, size: tuple[int, int], options: RasterOptions, colors: bool
    ) -> ProjectedGaussians:
        """See `Backend`."""
        return project_torch(gaussians, cameras, size, options, colors)

    def compositor(
        self,
        projected: ProjectedGaussians,
        features: Tensor,
        options: RasterOptions,
        median_depth: bool,
        chunk_size: int | None,
    ) -> Compositor:
        """See `Backend`."""
        return TorchCompositing(projected, features, options, median_depth, chunk_size)
