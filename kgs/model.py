"""The parameters of a splat: what the optimiser sees, and the activations that make Gaussians of them.

Source: B. Kerbl, G. Kopanas, T. Leimkühler, G. Drettakis, "3D Gaussian Splatting for Real-Time Radiance Field
Rendering", SIGGRAPH 2023, section 5: exponential for scales, sigmoid for opacities, isotropic start with the mean
distance to the three nearest points.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from .harmonics import SH_C0
from .types import SH_SIZES, Gaussians

__all__ = ["GaussianModel", "log_spacing"]

INITIAL_OPACITY = 0.1
NEIGHBOURS = 3
MIN_RELATIVE_SPACING = 1e-3
CHUNK_ELEMENTS = 1 << 24


class GaussianModel(nn.Module):
    """N Gaussians as parameters without bounds: log-scales, opacity logits and spherical harmonics.

    The harmonics are two parameters because they have two learning rates. `state_dict()` holds the six parameters and
    nothing else, so `GaussianModel(**state_dict)` rebuilds a model of any size; the active degree is the plain
    attribute `sh_degree`, to be saved beside it.

    Args:
        means: centres in world units, `(N, 3)`, float32 or float64.
        quats: rotations as quaternions w, x, y, z of any non-zero norm, `(N, 4)`.
        log_scales: natural logarithm of the standard deviations in world units, `(N, 3)`.
        opacity_logits: `(N,)`.
        sh_dc: harmonics of degree 0, `(N, 1, 3)`.
        sh_rest: harmonics of degree 1 and above, `(N, K - 1, 3)` with K = 1, 4, 9 or 16.
        sh_degree: the active degree, 0 to that of `sh_rest`; None takes the latter.

    Raises:
        TypeError: a tensor is not float32 or float64, or differs in dtype or device from `means`.
        ValueError: a tensor has another shape, or `sh_degree` is out of range.
    """

    means: nn.Parameter
    quats: nn.Parameter
    log_scales: nn.Parameter
    opacity_logits: nn.Parameter
    sh_dc: nn.Parameter
    sh_rest: nn.Parameter

    def __init__(
        self,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        opacity_logits: Tensor,
        sh_dc: Tensor,
        sh_rest: Tensor,
        sh_degree: int | None = None,
    ) -> None:
        super().__init__()
        n = len(means)
        k = sh_rest.shape[1] + 1 if sh_rest.ndim == 3 else 0
        if k not in SH_SIZES:
            raise ValueError(
                f"sh_rest: expected shape ({n}, K - 1, 3) with K in {SH_SIZES}, got {tuple(sh_rest.shape)}"
            )
        for name, value, shape in (
            ("means", means, (n, 3)),
            ("quats", quats, (n, 4)),
            ("log_scales", log_scales, (n, 3)),
            ("opacity_logits", opacity_logits, (n,)),
            ("sh_dc", sh_dc, (n, 1, 3)),
            ("sh_rest", sh_rest, (n, k - 1, 3)),
        ):
            if tuple(value.shape) != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {tuple(value.shape)}")
            if value.dtype not in (torch.float32, torch.float64):
                raise TypeError(f"{name}: expected float32 or float64, got {value.dtype}")
            if value.dtype != means.dtype or value.device != means.device:
                raise TypeError(
                    f"{name}: expected {means.dtype} on {means.device} as means, got {value.dtype} on {value.device}"
                )
            self.register_parameter(name, nn.Parameter(value.detach().clone()))
        self.sh_degree = self.max_sh_degree if sh_degree is None else sh_degree

    @classmethod
    def from_points(cls, points: Tensor, colors: Tensor, sh_degree: int = 3) -> GaussianModel:
        """Start from a coloured point cloud: one round, faint Gaussian a point, as wide as the points are apart.

        The standard deviation is the root of the mean squared distance to the three nearest points, at least a
        thousandth of the cloud's median one (points may coincide); the opacity is 0.1, the colour has no direction.

        Args:
            points: `(N, 3)` in world units, N >= 4, float32 or float64; the model takes their dtype and device.
            colors: RGB in [0, 1], `(N, 3)`, floating point.
            sh_degree: the degree of the harmonics, 0 to 3; the active degree starts there too.

        Raises:
            TypeError: `points` is not float32 or float64, or `colors` is not floating point.
            ValueError: shapes do not fit, there are fewer than 4 points, one is not finite, all coincide, or
                `sh_degree` is out of range.
        """
        if points.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"points: expected float32 or float64, got {points.dtype}")
        if not colors.is_floating_point():
            raise TypeError(f"colors: expected floating point values in [0, 1], got {colors.dtype}")
        if points.ndim != 2 or points.shape[1] != 3 or colors.shape != points.shape:
            raise ValueError(
                f"points, colors: expected two of shape (N, 3), got {tuple(points.shape)} and {tuple(colors.shape)}"
            )
        if len(points) <= NEIGHBOURS:
            raise ValueError(f"points: expected at least {NEIGHBOURS + 1} to take a spacing from, got {len(points)}")
        if not bool(torch.isfinite(points).all()):
            raise ValueError("points: expected finite coordinates, got NaN or infinity")
        if not isinstance(sh_degree, int) or not 0 <= sh_degree < len(SH_SIZES):
            raise ValueError(f"sh_degree: expected an integer from 0 to {len(SH_SIZES) - 1}, got {sh_degree!r}")
        points = points.detach()
        n = len(points)
        log_scales = log_spacing(points).to(points)
        dc = (colors.detach().to(points) - 0.5) / SH_C0
        return cls(
            means=points,
            quats=points.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            log_scales=log_scales[:, None].repeat(1, 3),
            opacity_logits=points.new_full((n,), math.log(INITIAL_OPACITY / (1.0 - INITIAL_OPACITY))),
            sh_dc=dc[:, None, :],
            sh_rest=points.new_zeros(n, SH_SIZES[sh_degree] - 1, 3),
        )

    @property
    def max_sh_degree(self) -> int:
        """The degree the harmonics have room for."""
        return math.isqrt(self.sh_rest.shape[1] + 1) - 1

    @property
    def sh_degree(self) -> int:
        """The active degree, 0 to `max_sh_degree`: bands above it are not evaluated and get no gradient."""
        return self._sh_degree

    @sh_degree.setter
    def sh_degree(self, value: int) -> None:
        if not isinstance(value, int) or not 0 <= value <= self.max_sh_degree:
            raise ValueError(f"sh_degree: expected an integer from 0 to {self.max_sh_degree}, got {value!r}")
        self._sh_degree = value

    def forward(self) -> Gaussians:
        """The Gaussians with activated values and the active bands only."""
        colors: Tensor = self.sh_dc
        if self.sh_degree > 0:
            active = self.sh_rest.narrow(1, 0, SH_SIZES[self.sh_degree] - 1)
            colors = torch.cat([self.sh_dc, active], dim=1)
        return Gaussians(
            means=self.means,
            quats=self.quats,
            scales=self.log_scales.exp(),
            opacities=self.opacity_logits.sigmoid(),
            colors=colors,
        )

    def __len__(self) -> int:
        return self.means.shape[0]

    def extra_repr(self) -> str:
        """What `print(model)` shows."""
        return f"{len(self)} Gaussians, sh_degree={self.sh_degree} of {self.max_sh_degree}, {self.means.dtype}"


def log_spacing(points: Tensor) -> Tensor:
    """Logarithm of the root mean squared distance to the three nearest points, float64 `(N,)`: the scale of a start.

    Args:
        points: `(N, 3)`, N >= 4.

    Raises:
        ValueError: all points are in one place.
    """
    points = points.double()
    centred = points - points.mean(dim=0)
    size = centred.abs().amax()
    if not bool(size > 0):
        raise ValueError("points: expected points in different places, got the same place for all")
    centred = centred / size  # float32 is then enough to find the neighbours, in whatever unit and place the cloud is
    neighbours = _nearest_on_cpu(centred) if points.device.type == "cpu" else _nearest(centred)
    difference = centred[neighbours] - centred[:, None, :]
    squared = difference.square().sum(dim=-1).mean(dim=-1)
    typical = squared[squared > 0].median()
    return 0.5 * squared.clamp(min=MIN_RELATIVE_SPACING**2 * typical).log() + size.log()


def _nearest_on_cpu(points: Tensor) -> Tensor:
    """Indices of the nearest other points, `(N, 3)`, by OpenCV's exact single k-d tree."""
    import cv2

    data = points.float().numpy()  # the index refers to this array, it makes no copy
    index = cv2.flann_Index(data, {"algorithm": 4})  # type: ignore[attr-defined]  # not in the stubs
    found, _ = index.knnSearch(data, NEIGHBOURS + 1, params={})
    return torch.from_numpy(found[:, 1:]).long()  # the first is at distance 0: the point itself or its double


def _nearest(points: Tensor) -> Tensor:
    """Indices of the nearest other points, `(N, 3)`, from all distances, a chunk of rows at a time."""
    data = points.float()
    rows = max(1, CHUNK_ELEMENTS // len(data))
    found = [
        torch.cdist(chunk, data, compute_mode="donot_use_mm_for_euclid_dist").topk(NEIGHBOURS + 1, largest=False)[1]
        for chunk in data.split(rows)
    ]
    return torch.cat(found)[:, 1:]
