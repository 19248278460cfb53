from . import cameras as cameras
from ._support.errors import ArgumentError as ArgumentError
from ._support.errors import DataError as DataError
from ._support.errors import TrainingDiverged as TrainingDiverged
from ._support.wait_policy import wait_passively as wait_passively
from .compressed_ply import save_compressed_ply as save_compressed_ply
from .densify import Densifier as Densifier
from .densify import DensifyReport as DensifyReport
from .drop import DropGaussian as DropGaussian
from .drop import drop_gaussian as drop_gaussian
from .geometry.cameras import PosedCamera as PosedCamera
from .geometry.cameras import pinhole_cameras as pinhole_cameras
from .geometry.rigs import camera_extent as camera_extent
from .geometry.types import Gaussians as Gaussians
from .geometry.types import ProjectedGaussians as ProjectedGaussians
from .geometry.types import RasterOptions as RasterOptions
from .geometry.types import Rendering as Rendering
from .gsplat import rasterization as rasterization
from .model import GaussianModel as GaussianModel
from .ply import load_ply as load_ply
from .ply import save_ply as save_ply
from .renderer import GaussianRenderer as GaussianRenderer
from .stages import composite as composite
from .stages import project as project

__version__: str
