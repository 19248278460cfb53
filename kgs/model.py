"""The model: the parameters of a splat, which an optimiser changes, and their activations to Gaussians.

Source: B. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023, section 5:
exponential for scales, sigmoid for opacities, isotropic start with the root mean squared distance to the three nearest
points (the release's: the paper says mean distance).
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from kgs._support.checks import check_tensor
from kgs._support.errors import ArgumentError, quoted

from .backends import Backend, get_backend
from .geometry.harmonics import SH_C0
from .geometry.spacing import log_spacing
from .geometry.types import SH_SIZES, Gaussians

INITIAL_OPACITY = 0.1
PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "sh_dc", "sh_rest")
MAX_SH_DEGREE = len(SH_SIZES) - 1


class GaussianModel(nn.Module):
    """N Gaussians as unbounded parameters. Harmonics are two of them, so that each can have its own learning rate.

    `state_dict()` holds the six parameters and the active degree: `GaussianModel(**state_dict)` builds the same model.
    `load_state_dict` takes over the number of Gaussians and both degrees. The parameters stay the same objects, so an
    optimiser still holds them; load its state afterwards.

    Args:
        means: centres in world units, `(N, 3)`, float32 or float64.
        quats: rotations as quaternions w, x, y, z of any norm of at least 1e-38, `(N, 4)`.
        log_scales: natural logarithm of the standard deviations in world units, `(N, 3)`; -inf for a flat disc.
        opacity_logits: the opacities before the sigmoid, `(N,)`; inf for 1, -inf for 0.
        sh_dc: harmonics of degree 0, `(N, 1, 3)`.
        sh_rest: harmonics of degree 1 and above, `(N, K - 1, 3)` with K = 1, 4, 9 or 16.
        sh_degree: the active degree, 0 to that of `sh_rest`; None takes that of `_extra_state`, else that of `sh_rest`.
        _extra_state: the active degree as `state_dict()` holds it.
        antialiased: whether the Gaussians were fitted with `RasterOptions(antialiased=True)`, and so must be rendered
            with it: `GaussianRenderer(antialiased=model.antialiased)`. No part of `state_dict()`.

    Raises:
        TypeError: a tensor is not float32 or float64, or differs in dtype or device from `means`.
        ValueError: a tensor has another shape, or `sh_degree` is out of range.

    Examples:
        >>> model = GaussianModel.from_points(torch.rand(20, 3), torch.rand(20, 3))
        >>> model.sh_degree = 1
        >>> GaussianModel(**model.state_dict())
        GaussianModel(20 Gaussians, sh_degree=1 of 3, torch.float32)
    """

    __call__: Callable[..., Gaussians]  # for type checkers, to which torch's says Any

    def __init__(
        self,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        opacity_logits: Tensor,
        sh_dc: Tensor,
        sh_rest: Tensor,
        sh_degree: int | None = None,
        _extra_state: Tensor | None = None,
        antialiased: bool = False,
    ) -> None:
        super().__init__()
        self.antialiased = antialiased
        values = dict(zip(PARAMETERS, (means, quats, log_scales, opacity_logits, sh_dc, sh_rest), strict=True))
        for name, value in values.items():
            check_tensor(name, value)
            _check_dtype(name, value)
            check_tensor(name, value, means, " as means")
        highest = _check_shapes(list(values.values()))
        self.means = nn.Parameter(means.detach().clone())
        self.quats = nn.Parameter(quats.detach().clone())
        self.log_scales = nn.Parameter(log_scales.detach().clone())
        self.opacity_logits = nn.Parameter(opacity_logits.detach().clone())
        self.sh_dc = nn.Parameter(sh_dc.detach().clone())
        self.sh_rest = nn.Parameter(sh_rest.detach().clone())
        if sh_degree is None:
            sh_degree = highest if _extra_state is None else int(_extra_state)
        self.sh_degree = sh_degree

    @classmethod
    def from_points(cls, points: Tensor, colors: Tensor, sh_degree: int = 3, scales: Tensor | None = None) -> Self:
        """Start from a coloured point cloud: each point becomes an isotropic Gaussian of its colour, with opacity 0.1.

        Args:
            points: `(N, 3)` in world units, float32 or float64; the model takes their dtype and device. N >= 4 without
                `scales`.
            colors: RGB in [0, 1], `(N, 3)`, floating point.
            sh_degree: the degree of the harmonics, 0 to 3; it is also the active degree.
            scales: the standard deviations in world units, `(N,)`. None: the root mean squared distance to the three
                nearest points, but at least a thousandth of the median over the cloud, because points may coincide.

        Raises:
            TypeError: `points` is not a tensor of float32 or float64, or `colors` is not floating point.
            ValueError: shapes do not match, there are fewer than 4 points, points are not finite or all equal, or
                `sh_degree` is out of range.
        """
        check_tensor("points", points)
        check_tensor("colors", colors)
        _check_dtype("points", points)
        if not colors.is_floating_point():
            raise TypeError(f"colors: expected floating point values, got {colors.dtype}")
        if points.ndim != 2 or points.shape[1] != 3 or colors.shape != points.shape:
            shapes = f"{tuple(points.shape)} and {tuple(colors.shape)}"
            raise ArgumentError("points, colors", "two of shape (N, 3)", shapes)
        for name, value in (("points", points), ("colors", colors)):
            if not bool(value.isfinite().all()):
                raise ArgumentError(name, "finite numbers", "NaN or infinity")
        _check_degree(sh_degree, MAX_SH_DEGREE)
        points = points.detach()
        n = len(points)
        if scales is not None and scales.shape != (n,):
            raise ArgumentError("scales", f"shape ({n},)", tuple(scales.shape))
        log_scales = log_spacing(points) if scales is None else scales.detach().log()
        return cls(
            means=points,
            quats=points.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            log_scales=log_scales.to(points)[:, None].repeat(1, 3),
            opacity_logits=points.new_full((n,), math.log(INITIAL_OPACITY / (1.0 - INITIAL_OPACITY))),
            sh_dc=((colors.detach().to(points) - 0.5) / SH_C0)[:, None],
            sh_rest=points.new_zeros(n, SH_SIZES[sh_degree] - 1, 3),
        )

    def per_gaussian(self) -> dict[str, nn.Parameter]:
        """The parameters with a row for each Gaussian, by name: those of the class, and none that was added to it."""
        return {name: self.get_parameter(name) for name in PARAMETERS}

    def select(self, rows: Tensor, sh_degree: int | None = None) -> "GaussianModel":
        """A new model of the Gaussians at `rows`: a mask `(N,)` or indices `(M,)`.

        `sh_degree` is the highest degree of the harmonics that are kept; None keeps all. A ValueError for a mask of
        another length.
        """
        if rows.dtype == torch.bool and rows.shape != (len(self),):
            raise ArgumentError("rows", f"a mask of shape ({len(self)},)", tuple(rows.shape))
        degree = self.max_sh_degree if sh_degree is None else _check_degree(sh_degree, self.max_sh_degree)
        values = {name: parameter.detach()[rows] for name, parameter in self.per_gaussian().items()}
        values["sh_rest"] = values["sh_rest"][:, : SH_SIZES[degree] - 1]
        return GaussianModel(**values, sh_degree=min(degree, self.sh_degree), antialiased=self.antialiased)

    @property
    def max_sh_degree(self) -> int:
        """The highest degree that the parameters can hold."""
        return math.isqrt(self.sh_rest.shape[1] + 1) - 1

    @property
    def sh_degree(self) -> int:
        """The active degree, 0 to `max_sh_degree`: bands above it are not evaluated and get no gradient."""
        return self._sh_degree

    @sh_degree.setter
    def sh_degree(self, value: int) -> None:
        self._sh_degree = _check_degree(value, self.max_sh_degree)

    def forward(self, *, backend: str | Backend = "auto") -> Gaussians:
        """The Gaussians: activated scales and opacities, and harmonics up to the active degree.

        A Gaussian whose scale overflows or is NaN has an infinite one, without gradient, and is not rendered; nor is
        one whose logit is NaN.

        Args:
            backend: "auto", or the name of one, see `kgs.backends`. By "triton" differentiable once.

        Raises:
            TypeError: the model is neither of float32 nor of float64.
            ValueError: the backend does not exist, or does not cover a model of this dtype or device.
            ModuleNotFoundError: the backend is numba or triton, and it is not installed.
        """
        chosen = get_backend(backend, self.means.device).covering("activation", self.means)
        # at degree 0 sh_rest gets no gradient, and an optimiser skips it
        parameters = (self.log_scales, self.opacity_logits, self.sh_dc, self.sh_rest)
        scales, opacities, colors = chosen.activate(*parameters, SH_SIZES[self.sh_degree])
        return Gaussians(self.means, self.quats, scales, opacities, colors)

    def __len__(self) -> int:
        return self.means.shape[0]

    def __bool__(self) -> bool:
        return True  # like every module, also without Gaussians

    def get_extra_state(self) -> Tensor:
        """The active degree, for `state_dict()`."""
        return torch.tensor(self.sh_degree, device="cpu")

    def set_extra_state(self, state: Tensor) -> None:
        """Set the active degree to that of a `state_dict()`."""
        self.sh_degree = int(state)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Resize the parameters to the values, then load them."""
        values = [state_dict[prefix + name] for name in PARAMETERS if prefix + name in state_dict]
        if len(values) == len(PARAMETERS):
            highest = _check_shapes(values)
            active = state_dict.setdefault(prefix + "_extra_state", torch.tensor(highest, device="cpu"))
            _check_degree(int(active), highest)
            for name, value in zip(PARAMETERS, values, strict=True):
                parameter = self.get_parameter(name)
                if parameter.shape != value.shape:
                    parameter.data = parameter.new_empty(value.shape)
                    parameter.grad = None
        super()._load_from_state_dict(state_dict, prefix, *args)

    def extra_repr(self) -> str:
        """Number, degrees and dtype, as `print(model)` displays them."""
        antialiased = ", antialiased" if self.antialiased else ""
        degrees = f"sh_degree={self.sh_degree} of {self.max_sh_degree}"
        return f"{len(self)} Gaussians, {degrees}, {self.means.dtype}{antialiased}"


def _check_dtype(name: str, value: Tensor) -> None:
    if value.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name}: expected float32 or float64, got {value.dtype}")


def _check_degree(value: int, highest: int) -> int:
    """The degree as an int; a ValueError if it is not one from 0 to the highest."""
    if not isinstance(value, int | np.integer) or not 0 <= value <= highest:
        raise ArgumentError("sh_degree", f"an integer from 0 to {highest}", quoted(value))
    return int(value)


def _check_shapes(values: Sequence[Tensor]) -> int:
    """The highest degree that the harmonics hold; a ValueError if the shapes of the `PARAMETERS` do not match."""
    means = values[0]
    sh_rest = values[-1]
    n = means.shape[0] if means.ndim else 0
    k = sh_rest.shape[1] + 1 if sh_rest.ndim == 3 else 0
    if k not in SH_SIZES:
        raise ArgumentError("sh_rest", f"shape ({n}, K - 1, 3) with K in {SH_SIZES}", tuple(sh_rest.shape))
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 1, 3), (n, k - 1, 3))
    for name, value, shape in zip(PARAMETERS, values, shapes, strict=True):
        if tuple(value.shape) != shape:
            raise ArgumentError(name, f"shape {shape}", tuple(value.shape))
    return SH_SIZES.index(k)
