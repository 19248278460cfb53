"""The values that flow through kgs: frozen dataclasses of tensors, one for each arrow of the pipeline.

    cameras --> project <- Gaussians
                   | ProjectedGaussians
                   v
              bin_to_tiles --> TileBins
                   v
               composite --> Rendering

Shapes, dtypes and devices are checked where a value is made by the user (`Gaussians`, `PosedCamera`); values never
are, because that would wait for the device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Gaussians", "ProjectedGaussians", "Rendering", "TileBins"]

SH_SIZES = (1, 4, 9, 16)


@dataclass(frozen=True)
class Gaussians:
    """A set of N Gaussians with activated values: what the renderer draws.

    Args:
        means: centres in world units, shape `(N, 3)`.
        quats: rotations as quaternions in the order w, x, y, z, of any non-zero norm, shape `(N, 4)`.
        scales: standard deviations along the local axes in world units, > 0, shape `(N, 3)`.
        opacities: shape `(N,)`, or `(C, N)` for one value a camera. In [0, 1], or above 1 after `DropGaussian`.
        colors: spherical harmonics `(N, K, 3)` with K = 1, 4, 9 or 16 (degree 0 to 3), or RGB `(N, 3)`.

    Raises:
        TypeError: a field is no tensor, is not float32 or float64, or differs in dtype or device from `means`.
        ValueError: a field has another shape.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor

    def __post_init__(self) -> None:
        for name in ("means", "quats", "scales", "opacities", "colors"):
            value = getattr(self, name)
            if not isinstance(value, Tensor):
                raise TypeError(f"{name}: expected a torch.Tensor, got {type(value).__name__}")
            if value.dtype not in (torch.float32, torch.float64):
                raise TypeError(f"{name}: expected float32 or float64, got {value.dtype}")
            if value.dtype != self.means.dtype or value.device != self.means.device:
                raise TypeError(
                    f"{name}: expected {self.means.dtype} on {self.means.device} as means, "
                    f"got {value.dtype} on {value.device}"
                )
        n = self.means.shape[0] if self.means.ndim else 0
        _check_shape("means", self.means, (n, 3))
        _check_shape("quats", self.quats, (n, 4))
        _check_shape("scales", self.scales, (n, 3))
        if self.opacities.ndim not in (1, 2) or self.opacities.shape[-1] != n:
            raise ValueError(f"opacities: expected shape ({n},) or (C, {n}), got {tuple(self.opacities.shape)}")
        if self.colors.ndim == 2:
            _check_shape("colors", self.colors, (n, 3))
        elif self.colors.ndim != 3 or self.colors.shape[1] not in SH_SIZES:
            raise ValueError(
                f"colors: expected shape ({n}, 3) or ({n}, K, 3) with K in {SH_SIZES}, got {tuple(self.colors.shape)}"
            )
        else:
            _check_shape("colors", self.colors, (n, self.colors.shape[1], 3))

    def __len__(self) -> int:
        return self.means.shape[0]


@dataclass(frozen=True)
class ProjectedGaussians:
    """The M pairs (camera, Gaussian) that a camera can see: in front of the near plane and over the image.

    Being in this list is being visible, whatever the opacity: a Gaussian that `DropGaussian` switched off is listed
    all the same (it is never composited). The list is ordered by camera, then by Gaussian.

    Convention:
        Pixels with integer centres: the image covers [-0.5, W - 0.5] x [-0.5, H - 0.5].

    Args:
        camera_ids: `(M,)` int64.
        gaussian_ids: `(M,)` int64.
        means2d: projected centres in pixels, `(M, 2)`. With gradients on, its `.grad` is kept.
        factors: `(M, 2, 3)`, the product J W R S in pixels: the covariance is `factors @ factors.mT + eps2d I`.
        depths: z in the camera frame, `(M,)`.
        radii: ceil(3 sqrt(largest variance)) in pixels, independent of the opacity, `(M,)`.
        opacities: `(M,)`.
        colors: `(M, 3)`, or `(M, 0)` where no image was asked for.
        image_size: (height, width) in pixels.
        num_cameras: C.
        num_gaussians: N.
        num_nonfinite: how many Gaussians were left out because a parameter is NaN or infinite; 0-d int64 tensor.
        eps2d: the variance in px^2 added to the diagonal.
    """

    camera_ids: Tensor
    gaussian_ids: Tensor
    means2d: Tensor
    factors: Tensor
    depths: Tensor
    radii: Tensor
    opacities: Tensor
    colors: Tensor
    image_size: tuple[int, int]
    num_cameras: int
    num_gaussians: int
    num_nonfinite: Tensor
    eps2d: float

    @property
    def conics(self) -> Tensor:
        """Inverse covariances (a, b, c), meaning a dx^2 + 2 b dx dy + c dy^2, shape `(M, 3)`."""
        from .covariance import conics

        return conics(self.factors, self.eps2d)

    def __len__(self) -> int:
        return self.camera_ids.shape[0]


@dataclass(frozen=True)
class TileBins:
    """For each tile the Gaussians that can reach it, front to back; integers without gradient.

    Tiles are numbered row by row, camera after camera: tile t of the band is tile `first_tile + t` overall.

    Args:
        tile_size: side of a tile in pixels.
        grid: (rows, columns) of tiles in one image.
        first_tile: number of the band's first tile among all tiles of all cameras.
        offsets: `(T + 1,)` int64; the entries of tile t are `offsets[t]:offsets[t + 1]`.
        entries: `(E,)` int32, position in `ids`, sorted by tile and then from front to back.
        ids: `(n,)` int64, the rows of `ProjectedGaussians` that may have entries, in depth order.
        order: `(E,)` int64, which place each entry has if they are sorted by `ids` first and then by tile.
    """

    tile_size: int
    grid: tuple[int, int]
    first_tile: int
    offsets: Tensor
    entries: Tensor
    ids: Tensor
    order: Tensor

    @property
    def num_tiles(self) -> int:
        """How many tiles the band has."""
        return self.offsets.shape[0] - 1

    @property
    def by_gaussian(self) -> Tensor:
        """The entries of `ids[0]`, then of `ids[1]`, ..., `(E,)` int64; computed at each call."""
        entries = torch.arange(self.order.shape[0], device=self.order.device)
        return torch.empty_like(self.order).scatter_(0, self.order, entries)

    @property
    def gaussian_offsets(self) -> Tensor:
        """Where the entries of each of `ids` begin in `by_gaussian`, `(n,)` int64; computed at each call."""
        counts = torch.bincount(self.entries, minlength=self.ids.shape[0])
        return torch.cumsum(counts, 0) - counts


@dataclass(frozen=True)
class Rendering:
    """What a render call returns; a field that was not asked for is None and was not computed.

    Args:
        image: `(C, 3, H, W)`, not clamped.
        alpha: `(C, 1, H, W)`, 1 - transmittance.
        depth: `(C, 1, H, W)`, the mean depth weighted by contribution; 0 where alpha < 1e-6.
        median_depth: `(C, 1, H, W)`, depth of the first layer behind which less than half the light remains;
            0 where there is none. No gradient.
        projected: the Gaussians that were seen.
    """

    image: Tensor | None
    alpha: Tensor | None
    depth: Tensor | None
    median_depth: Tensor | None
    projected: ProjectedGaussians


def sh_degree(colors: Tensor) -> int:
    """Degree of harmonics `(N, K, 3)`."""
    return math.isqrt(colors.shape[1]) - 1


def _check_shape(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {tuple(value.shape)}")
