"""Differentiable 3D Gaussian splatting for sparse views, in PyTorch and Kornia, with DropGaussian as a layer.

The method: `geometry` (Gaussians, cameras and the closed forms between them), `backends`, which compute with it, and
`drop` (the layer), `renderer`, `model`, `stages` (project, composite), `reference` (the dense renderer), `densify`,
`ply`, `compressed_ply`. `losses`, `datasets`, `init_points`, `fit` and `metrics` go from photos to a measured splat;
`gsplat` has gsplat's interface; `app` is the command.
"""

import os

from ._support.lazy import public_names
from ._support.version import __version__ as __version__

if not os.path.isdir(os.path.join(__path__[0], "losses")):  # in a clone that is not installed it lies beside `kgs`
    __path__.append(os.path.dirname(__path__[0]))

# so that the command `kgs` can answer before torch is loaded
__getattr__, __dir__, __all__ = public_names(__name__, __file__)
