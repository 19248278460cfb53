"""What a backend is: where it runs, and its stages as methods."""

import functools
import importlib.util
from abc import ABC, abstractmethod
from typing import Any, Protocol

import torch
from torch import Tensor

from kgs.camera import Cameras
from kgs.types import Gaussians, ProjectedGaussians, RasterOptions

Inputs = tuple[Tensor, Tensor, Tensor, Tensor]  # means2d (M, 2), factors (M, 2, 3), opacities (M,), features (M, F)


class Compositor(Protocol):
    """Compositing of one call, forward and backward, on tile lists that its constructor makes.

    `kgs.stages` wraps it in the one autograd function. Autograd records none of its methods.
    """

    def forward(self, inputs: Inputs, keep: bool) -> tuple[tuple[Tensor, Tensor, Tensor], Any]:
        """Features `(C, F, H, W)`, transmittance `(C, 1, H, W)`, median depth `(C, 1 or 0, H, W)`; and what was kept.

        With `keep`, any state may be kept for `backward`; None where memory is short.
        """

    def backward(
        self, inputs: Inputs, kept: Any, grad_features: Tensor, grad_transmittance: Tensor, needs: tuple[bool, ...]
    ) -> tuple[Tensor | None, ...]:
        """The gradients of the inputs, None for those that are not needed; and last, or None, `(M, 2)`.

        The last are the sums of absolute values of :class:`kgs.RasterOptions`, made where `options.absgrad` asks for
        them and a gradient of means2d is needed.

        `kept` is what `forward` kept, or None in a second backward pass: then it is computed again.
        """


class Backend(ABC):
    """An implementation of the renderer. Torch defines what is right; others give the same within rounding.

    The arguments of the stages have been checked.

    Attributes:
        name: what `backend=` calls it.
        devices: the types of torch devices it runs on; None for all.
        dtypes: of the tensors it works on.
        tile_size: side of its tiles in pixels, where `RasterOptions.tile_size` is None.
        package: what must be installed beside torch, and how to install it; None for nothing.
        has_loss: whether it has `loss_and_gradient`.
    """

    name: str
    devices: tuple[str, ...] | None = None
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64)
    tile_size: int = 8
    package: tuple[str, str] | None = None
    has_loss = False

    def is_installed(self) -> bool:
        """Whether the package it needs is there; does not import it."""
        return self.package is None or _is_found(self.package[0])

    def runs_on(self, device: torch.device) -> bool:
        """Whether it runs on such a device."""
        return self.devices is None or device.type in self.devices

    def is_trusted(self, device: torch.device) -> bool:
        """Whether "auto" may take it on this device. The first call may take seconds, and say in a line why not."""
        return True

    def covers(self, like: Tensor) -> bool:
        """Whether it works on tensors of this dtype, on this device; cheap, reads no values."""
        return like.dtype in self.dtypes and self.runs_on(like.device) and self.is_installed()

    def covers_compositing(
        self, projected: ProjectedGaussians, features: Tensor, options: RasterOptions, chunk_size: int | None
    ) -> bool:
        """Whether it composites under these options; cheap, reads no values of tensors."""
        return True

    @abstractmethod
    def project(
        self, gaussians: Gaussians, cameras: Cameras, size: tuple[int, int], options: RasterOptions, colors: bool
    ) -> ProjectedGaussians:
        """The stage of :func:`kgs.project`, for images of `size` (height, width); `colors`: whether they are wanted."""

    @abstractmethod
    def compositor(
        self,
        projected: ProjectedGaussians,
        features: Tensor,
        options: RasterOptions,
        median_depth: bool,
        chunk_size: int | None,
    ) -> Compositor:
        """The stage of :func:`kgs.composite`: bins the Gaussians to tiles; `options.tile_size` is a number."""

    def loss_and_gradient(
        self,
        image: Tensor,
        target: Tensor,
        mean: Tensor,
        variance: Tensor,
        taps: list[float],
        dssim_weight: float,
        gradient: bool,
    ) -> tuple[Tensor, Tensor | None]:
        """L1 + `dssim_weight` (1 - SSIM), 0-d, and its gradient by the image if that is wanted.

        Images are `(B, C, H, W)`, H and W at least the window; `mean` and `variance` `(1, B C, H, W)` those of the
        target under the window with these taps. See `kgs.losses.photometric`, which has all of it in torch.
        """
        raise NotImplementedError(f"{self.name} has no photometric loss")


@functools.cache
def _is_found(package: str) -> bool:
    return importlib.util.find_spec(package) is not None
