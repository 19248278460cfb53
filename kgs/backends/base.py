"""What a backend is: where it runs, and its stages. The signature of each stage is stated here, once."""

import functools
import importlib.util
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from kgs.geometry.cameras import Cameras
from kgs.geometry.types import Gaussians, ProjectedGaussians, RasterOptions


class ActivationStage(Protocol):
    """The stage of :class:`kgs.GaussianModel`."""

    def __call__(
        self, log_scales: Tensor, opacity_logits: Tensor, sh_dc: Tensor, sh_rest: Tensor, bands: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Scales, infinite and without gradient where they overflow, opacities, and harmonics `(N, bands, 3)`.

        With 1 band the latter are `sh_dc` itself; the gradient of `sh_rest` is 0 in bands that are not asked for.
        """


class ProjectionStage(Protocol):
    """The stage of :func:`kgs.project`."""

    def __call__(
        self, gaussians: Gaussians, cameras: Cameras, size: tuple[int, int], options: RasterOptions, colors: bool
    ) -> ProjectedGaussians:
        """Project Gaussians into all cameras, whose images have `size` (height, width).

        `far_plane`, `radius_clip` and `antialiased` of the options are applied afterwards, by `kgs.stages`. `colors`
        says whether colours are computed.
        """


@dataclass(frozen=True, eq=False)
class CompositingCall:
    """The arguments of one :func:`kgs.composite`, which have been checked.

    Args:
        projected: M visible pairs (camera, Gaussian).
        features: `(M, F)`.
        options: `tile_size` is a number by the time a compositor is made.
        median_depth: whether the median depth is wanted.
        chunk_size: entries of a tile per step of the torch backend; None chooses.
    """

    projected: ProjectedGaussians
    features: Tensor
    options: RasterOptions
    median_depth: bool = False
    chunk_size: int | None = None


class CompositingInputs(NamedTuple):
    """The tensors that compositing differentiates with respect to."""

    means2d: Tensor  # (M, 2)
    factors: Tensor  # (M, 2, 3)
    opacities: Tensor  # (M,)
    features: Tensor  # (M, F)


Images = tuple[Tensor, Tensor, Tensor]  # features (C, F, H, W), transmittance (C, 1, H, W), median (C, 1 or 0, H, W)


class Compositor(ABC):
    """Compositing of one call, forward and backward, on tile lists that its constructor makes.

    `kgs.stages` wraps it in the one autograd function. Autograd records none of its methods.
    """

    @abstractmethod
    def __init__(self, call: CompositingCall) -> None:
        """Find which tiles each Gaussian reaches, and the row slices whose lists fit into `max_bytes`."""

    @abstractmethod
    def forward(self, inputs: CompositingInputs, keep: bool) -> tuple[Images, Any]:
        """Features, transmittance and median depth of all pixels, and what is kept for `backward`.

        With `keep` any state may be kept, None where memory is short.
        """

    @abstractmethod
    def backward(
        self,
        inputs: CompositingInputs,
        kept: Any,
        grad_features: Tensor,
        grad_transmittance: Tensor,
        needs: tuple[bool, ...],
    ) -> tuple[tuple[Tensor | None, ...], Tensor | None]:
        """The gradients of the inputs, None for those that are not needed; and the sums of absolute values, or None.

        The latter, `(M, 2)`, are those of :class:`kgs.RasterOptions`, made where `options.absgrad` asks for them and a
        gradient of means2d is needed. `kept` is what `forward` kept, or None in a second backward pass: then it is
        computed again.
        """


class BlendingStage(Protocol):
    """The last stage of a render."""

    def __call__(self, image: Tensor, transmittance: Tensor, background: Tensor) -> Tensor:
        """The image `(C, D, H, W)` plus the transmittance `(C, 1, H, W)` times the background.

        The background is `(D, 1, 1)`, or of any shape that can be expanded to the image's. Where the transmittance is
        0 nothing is added, of an infinite background too.
        """


class LossStage(ABC):
    """The stage of :func:`kgs.losses.photometric_loss`, forward and backward.

    `kgs.losses.photometric` has all of it in torch, and wraps it in an autograd function.
    """

    @abstractmethod
    def forward(
        self,
        image: Tensor,
        target: Tensor,
        mean: Tensor,
        variance: Tensor,
        taps: list[float],
        dssim_weight: float,
        keep: bool,
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """L1 + `dssim_weight` (1 - SSIM), 0-d, and with `keep` what `backward` needs.

        Images are `(B, C, H, W)`, H and W at least the window; `mean` and `variance` `(1, B C, H, W)` those of the
        target under the window with these taps.
        """

    @abstractmethod
    def backward(self, kept: tuple[Tensor, ...], taps: list[float], dssim_weight: float, grad: Tensor) -> Tensor:
        """From the gradient of the loss, 0-d, to that of the image; `kept` stays as it is."""


class MomentsStage(Protocol):
    """The stage of :func:`kgs.losses.target_moments`."""

    def __call__(self, target: Tensor, taps: list[float]) -> tuple[Tensor, Tensor]:
        """Mean and variance under the window with these taps, each `(1, B C, H, W)`, of `(B, C, H, W)`."""


class AdamUpdate(NamedTuple):
    """What a step of Adam changes, and by what: four tensors of one shape, contiguous but for the gradient."""

    parameter: Tensor
    gradient: Tensor
    exp_avg: Tensor
    exp_avg_sq: Tensor
    lr: float
    step: float  # from 1: this one counts


class OptimizerStages(ABC):
    """What a fit does with the gradients, in place."""

    @abstractmethod
    def adam(self, updates: list[AdamUpdate], betas: tuple[float, float], eps: float) -> None:
        """Change parameters and moments as `kgs.fit.adam.Adam` does."""

    @abstractmethod
    def add_gradient_norms(
        self, sums: Tensor, counts: Tensor, ids: Tensor, gradient: Tensor, scale: tuple[float, float]
    ) -> None:
        """Add the norms of gradients `(M, 2)`, times a scale in x and y, to `sums`, `(N,)`, and 1 to `counts`, `(N,)`.

        `ids`, `(M,)`, are the rows, each there once at most. See `kgs.Densifier.observe`.
        """

    @abstractmethod
    def decay_opacity(self, logits: Tensor, factor: float) -> None:
        """Multiply the opacities with these logits, `(N,)`, contiguous, by a factor in (0, 1)."""


class Backend(ABC):
    """An implementation of the renderer. Torch defines what is right; others give the same within rounding.

    The arguments of the stages have been checked.

    Attributes:
        name: what `backend=` calls it.
        devices: the types of torch devices it runs on; None for all.
        dtypes: of the tensors it works on.
        tile_size: side of its tiles in pixels, where `RasterOptions.tile_size` is None.
        package: what must be installed beside torch, and how to install it; None for nothing.
        has_loss: whether it has `loss`.
        has_moments: whether it has `local_moments`.
        has_optimizer: whether it has `optimizer`.
    """

    name: str
    devices: tuple[str, ...] | None = None
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64)
    tile_size: int = 8
    package: tuple[str, str] | None = None
    has_loss = False
    has_moments = False
    has_optimizer = False

    def is_installed(self) -> bool:
        """Whether the package it needs is there; does not import it."""
        return self.package is None or _is_found(self.package[0])

    def runs_on(self, device: torch.device) -> bool:
        """Whether it runs on such a device."""
        return self.devices is None or device.type in self.devices

    def is_trusted(self, device: torch.device) -> bool:
        """Whether "auto" may take it on this device. The first call may take seconds, and say in a line why not."""
        return True

    def compile_ahead(self, run: Callable[[torch.device], object], device: torch.device) -> None:
        """Compile what a piece of code needs on a device, all at once, where the backend can; reports no error.

        Args:
            run: calls stages of this backend, with tensors of the device that it is given.
            device: where it will run.
        """
        return

    def covers(self, like: Tensor) -> bool:
        """Whether it works on tensors of this dtype and device, while no graph is traced; cheap, reads no values."""
        if torch.compiler.is_compiling():
            return False
        return like.dtype in self.dtypes and self.runs_on(like.device) and self.is_installed()

    def covers_compositing(self, call: CompositingCall) -> bool:
        """Whether it composites with these options; cheap, reads no values of tensors."""
        return True

    @property
    @abstractmethod
    def activate(self) -> ActivationStage:
        """Its activations."""

    @property
    @abstractmethod
    def project(self) -> ProjectionStage:
        """Its projection."""

    @property
    @abstractmethod
    def compositor(self) -> type[Compositor]:
        """Its compositing."""

    @property
    @abstractmethod
    def blend(self) -> BlendingStage:
        """Its blending with a background."""

    @property
    def loss(self) -> LossStage:
        """Its photometric loss, where it has one."""
        raise NotImplementedError(f"{self.name} has no photometric loss")

    @property
    def local_moments(self) -> MomentsStage:
        """Its moments of a target, where it has them."""
        raise NotImplementedError(f"{self.name} has no local moments")

    @property
    def optimizer(self) -> OptimizerStages:
        """Its stages of an optimizer, where it has them."""
        raise NotImplementedError(f"{self.name} has no stages of an optimizer")


@functools.cache
def _is_found(package: str) -> bool:
    return importlib.util.find_spec(package) is not None
