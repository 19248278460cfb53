"""The values that flow through kgs: Gaussians -> `project` -> ProjectedGaussians -> `composite` -> Rendering.

Shapes, dtypes and devices are checked when the user creates an object; numbers are not, because reading them would
synchronise with the device. Two objects are equal only if they are the same object.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Any, Self

import torch
from torch import Tensor

from kgs._support.checks import check_kind, check_tensor
from kgs._support.errors import ArgumentError, quoted
from kgs._support.shown import ShownByShapes

from .covariance import conics, variances

SH_SIZES = (1, 4, 9, 16)


@dataclass(frozen=True)
class RasterOptions:
    """How Gaussians become pixels: the options of the renderer, with their defaults and ranges.

    Args:
        tile_size: side of a tile in pixels, >= 1; None for the backend's own (8). The speed depends on it, the
            image only by rounding (float32: about 1e-6 at 16, growing with the square).
        near_plane: Gaussians with z <= near_plane are left out; in world units, >= 0. Below 1e-7 perspective cameras
            are not exact (Kornia does not divide by less than 1e-8).
        eps2d: variance in px^2 added to the diagonal of each footprint, >= 0: the low-pass filter of 3DGS.
        alpha_threshold: alphas below it are skipped, in [0, 1). It trades accuracy for time: 0 is exact, and the
            error is at most this value times the number of Gaussians that cover the pixel.
        transmittance_stop: transmittance below it counts as 0, in [0, 1); the error is at most this value.
        max_bytes: bound for the working memory of one call in bytes, without what is kept per Gaussian and per pixel.
            An image that needs more is rendered in row slices; those that are not kept within the bound are computed
            again by the backward pass. None: 1 GiB; the kernels of a GPU take up to half of its free memory, so that
            gradients of an image which needs more than 1 GiB can differ by rounding with what else is on the card.
        frame: (left, top, right, bottom) in pixels of the image; None for the whole image. Footprints are linearised no
            farther than 15 % of the frame's size beyond its borders. A render that is wider than the images which the
            Gaussians were fitted to shows the same inside their frame if it is given: else off-frame Gaussians get
            huge footprints that fog the image.
        absgrad: `backward` also sets `projected.means2d.absgrad`, `(M, 2)` in units of `means2d.grad`: the sums, over
            pixels, of the absolute values of each pixel's contribution to the gradient of a centre. Where pixels pull a
            Gaussian apart the gradient vanishes, and these sums do not (AbsGS, Ye et al., ACM MM 2024).
        far_plane: Gaussians with z >= far_plane are left out; in world units, beyond the near plane.
        radius_clip: Gaussians whose footprint reaches no farther than this along x and along y, in pixels, are left
            out; >= 0. It reaches 3.33 standard deviations, rounded up.
        antialiased: multiply opacities by sqrt(det Sigma / det(Sigma + eps2d I)), so that the low-pass filter widens
            small footprints without making them brighter (Mip-Splatting, Yu et al., CVPR 2024; there with eps2d 0.1).
            Choose it before a fit: a splat that was fitted without it is too faint with it.

    Raises:
        ValueError: an option is out of range.
    """

    tile_size: int | None = None
    near_plane: float = 0.01
    eps2d: float = 0.3
    alpha_threshold: float = 1 / 255
    transmittance_stop: float = 1e-4
    max_bytes: int | None = None
    frame: tuple[float, float, float, float] | None = None
    absgrad: bool = False
    far_plane: float = math.inf
    radius_clip: float = 0.0
    antialiased: bool = False

    def __post_init__(self) -> None:
        for name in ("absgrad", "antialiased"):
            if not isinstance(getattr(self, name), bool):
                raise ArgumentError(name, "True or False", quoted(getattr(self, name)))
        for name in ("tile_size", "max_bytes"):
            value: Any = getattr(self, name)
            if value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, Integral) or int(value) < 1:
                raise ArgumentError(name, "an integer >= 1", quoted(value))
            object.__setattr__(self, name, int(value))
        limits = {"near_plane": math.inf, "radius_clip": math.inf, "eps2d": math.inf}
        limits |= {"alpha_threshold": 1, "transmittance_stop": 1}
        for name, limit in limits.items():
            value = getattr(self, name)
            if not isinstance(value, Real) or not 0.0 <= float(value) < limit:
                raise ArgumentError(name, f"a number in [0, {limit})", quoted(value))
            object.__setattr__(self, name, float(value))  # kernels are compiled for Python's floats, not NumPy's
        far: Any = self.far_plane
        if not isinstance(far, Real) or not self.near_plane < float(far):
            raise ArgumentError("far_plane", f"more than the near plane, {self.near_plane}", quoted(far))
        object.__setattr__(self, "far_plane", float(far))
        if self.frame is not None:
            if not _is_frame(self.frame):
                raise ArgumentError("frame", "(left, top, right, bottom) with a positive size", quoted(self.frame))
            object.__setattr__(self, "frame", tuple(map(float, self.frame)))


def _is_frame(frame: Any) -> bool:
    """Whether a value is (left, top, right, bottom), finite and of a positive size."""
    if not isinstance(frame, tuple) or len(frame) != 4:
        return False
    if not all(isinstance(edge, Real) and math.isfinite(edge) for edge in frame):
        return False
    return bool(frame[0] < frame[2] and frame[1] < frame[3])


def raster_options(options: RasterOptions | None, fields: Mapping[str, Any]) -> RasterOptions:
    """The options of a call, given whole or field by field.

    Raises:
        TypeError: both are given, `options` is of another type, or a field does not exist.
        ValueError: a field is out of range.
    """
    known = RasterOptions.__annotations__
    unknown = sorted(fields.keys() - known.keys())
    if unknown:
        listed = ", ".join(known)
        raise TypeError(f"{unknown[0]}: unexpected keyword argument, expected options of the rasteriser ({listed})")
    if options is None:
        return RasterOptions(**fields)
    check_kind("options", options, RasterOptions)
    if fields:
        raise TypeError(f"options: expected options= or keyword arguments, got both ({', '.join(fields)})")
    return options


@dataclass(frozen=True, eq=False, repr=False)
class Gaussians(ShownByShapes):
    """A set of N Gaussians with activated values: the input of the renderer.

    Convention:
        World coordinates; a quaternion turns local axes into those of the world, the columns of R are local axes.

    Args:
        means: centres in world units, shape `(N, 3)`.
        quats: rotations as quaternions in the order w, x, y, z, of any norm from 1e-38 on, shape `(N, 4)`. Or matrices
            A `(N, 3, 3)` in their place, where the covariance is A S S A^T: rotations, or any others.
        scales: standard deviations along the local axes in world units, > 0, shape `(N, 3)`.
        opacities: shape `(N,)`, or `(C, N)` for one value per camera. In [0, 1], or above 1 after `DropGaussian`.
        colors: spherical harmonics `(N, K, 3)` with K = 1, 4, 9 or 16 (degree 0 to 3); or features `(N, D)` that are
            rendered as they are, RGB for D = 3.

    Raises:
        TypeError: a field is not a tensor, is not float32 or float64, or differs in dtype or device from `means`.
        ValueError: a field has another shape.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_tensor(name, value)
            if value.dtype not in (torch.float32, torch.float64):
                raise TypeError(f"{name}: expected float32 or float64, got {value.dtype}")
            check_tensor(name, value, self.means, " as means")
        n = self.means.shape[0] if self.means.ndim else 0
        for name, width in (("means", 3), ("quats", 4), ("scales", 3)):
            got = tuple(getattr(self, name).shape)
            if got != (n, width) and (name, got) != ("quats", (n, 3, 3)):
                rows = "N" if name == "means" else n
                raise ArgumentError(name, f"shape ({rows}, {width})", got)
        if self.opacities.ndim not in (1, 2) or self.opacities.shape[-1] != n:
            raise ArgumentError("opacities", f"shape ({n},) or (C, {n})", tuple(self.opacities.shape))
        shape = tuple(self.colors.shape)
        fits = len(shape) == 2 or (len(shape) == 3 and shape[1] in SH_SIZES and shape[2] == 3)
        if not fits or shape[0] != n:
            raise ArgumentError("colors", f"shape ({n}, D) or ({n}, K, 3) with K in {SH_SIZES}", shape)

    def __len__(self) -> int:
        return self.means.shape[0]

    def __bool__(self) -> bool:
        return True  # also without Gaussians

    def __getitem__(self, index: Tensor | slice) -> Self:
        """Some of the Gaussians: those of a mask `(N,)`, of indices `(M,)` or of a slice; a TypeError for one index."""
        given: Any = index
        if isinstance(given, Integral):
            raise TypeError(f"index: expected a mask, indices or a slice, got {given}")
        fields = {name: value[index] for name, value in vars(self).items() if name != "opacities"}
        return replace(self, **fields, opacities=self.opacities[..., index])

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """The Gaussians on another device or in another dtype; arguments as of `torch.Tensor.to`."""
        return replace(self, **{name: value.to(*args, **kwargs) for name, value in vars(self).items()})


@dataclass(frozen=True, eq=False, repr=False)
class ProjectedGaussians(ShownByShapes):
    """The M pairs (camera, Gaussian) where the Gaussian lies beyond the near plane and touches the image.

    A Gaussian is listed whatever its opacity, even if `DropGaussian` set it to 0 (it is then not composited).
    The list is ordered by camera, then by Gaussian.

    Convention:
        Pixels with integer centres: the image covers [-0.5, W - 0.5] x [-0.5, H - 0.5].

    Args:
        camera_ids: `(M,)` int64.
        gaussian_ids: `(M,)` int64.
        means2d: projected centres in pixels, `(M, 2)`. Call `means2d.retain_grad()` before `backward` to keep its
            `.grad`, as :meth:`kgs.Densifier.observe` needs.
        factors: `(M, 2, 3)`, the product J W R S in pixels: the covariance is `factors @ factors.mT + eps2d I`.
        depths: z in the camera frame, `(M,)`.
        radii: ceil(3 sqrt(largest variance)) in pixels, independent of the opacity, `(M,)`. `radius_clip` and
            `meta["radii"]` of `kgs.rasterization` take 3.33 standard deviations along each axis instead.
        opacities: `(M,)`; those of an antialiased render are multiplied by its factor.
        colors: `(M, 3)`, or features `(M, D)`, or `(M, 0)` if no image was requested.
        image_size: (height, width) in pixels.
        num_cameras: C.
        num_gaussians: N.
        num_nonfinite: the number of Gaussians that were left out because a parameter is NaN or infinite; 0-d int64.
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
        return conics(*variances(self.factors, self.eps2d))

    def __len__(self) -> int:
        return self.camera_ids.shape[0]


@dataclass(frozen=True, eq=False, repr=False)
class Composited(ShownByShapes):
    """Sums over the Gaussians of each pixel, before background and normalisation."""

    features: Tensor  # sum of w times features, (C, F, H, W)
    transmittance: Tensor  # T behind the last Gaussian, (C, 1, H, W)
    median_depth: Tensor | None  # (C, 1, H, W), without gradient
    tile_size: int  # side of the tiles that were used, in pixels


@dataclass(frozen=True, eq=False, repr=False)
class Rendering(ShownByShapes):
    """What a render call returns; a field that was not requested is None and was not computed.

    Args:
        image: `(C, 3, H, W)`, or `(C, D, H, W)` of features, not clamped.
        alpha: `(C, 1, H, W)`, 1 - transmittance.
        depth: `(C, 1, H, W)`, the mean depth weighted by contribution, so divided by alpha; 0 where alpha < 1e-6.
        median_depth: `(C, 1, H, W)`, depth of the first Gaussian behind which the transmittance is below 1/2;
            0 where there is none. No gradient.
        projected: the visible Gaussians.
        normal: `(C, 3, H, W)`, the sum of contribution times normal: the shortest axis of each Gaussian, of length 1,
            turned towards the camera, in world axes. Not normalised.
    """

    image: Tensor | None
    alpha: Tensor | None
    depth: Tensor | None
    median_depth: Tensor | None
    projected: ProjectedGaussians
    normal: Tensor | None = None
