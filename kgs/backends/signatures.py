"""The signature of each stage of a backend, stated once; `kgs.backends.table` has the table of them.

The arguments of a stage have been checked.
"""

from abc import ABC, abstractmethod
from typing import NamedTuple, Protocol

from torch import Tensor

from kgs.geometry.cameras import Cameras
from kgs.geometry.types import Gaussians, ProjectedGaussians, RasterOptions


class Activate(Protocol):
    """The activations of :class:`kgs.GaussianModel`."""

    def __call__(
        self, log_scales: Tensor, opacity_logits: Tensor, sh_dc: Tensor, sh_rest: Tensor, bands: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Scales, infinite and without gradient where they overflow, opacities, and harmonics `(N, bands, 3)`.

        With 1 band the latter are `sh_dc` itself; the gradient of `sh_rest` is 0 in bands that are not asked for.
        """


class Project(Protocol):
    """The projection of :func:`kgs.project`."""

    def __call__(
        self, gaussians: Gaussians, cameras: Cameras, size: tuple[int, int], options: RasterOptions, colors: bool
    ) -> ProjectedGaussians:
        """Gaussians as all cameras see them, whose images have `size` (height, width).

        `far_plane`, `radius_clip` and `antialiased` of the options are applied afterwards, by `kgs.stages`. `colors`
        says whether colours are computed.
        """


Inputs = tuple[Tensor, Tensor, Tensor, Tensor]  # means2d (M, 2), factors (M, 2, 3), opacities (M,), features (M, F)
Images = tuple[Tensor, Tensor, Tensor]  # features (C, F, H, W), transmittance (C, 1, H, W), median (C, 1 or 0, H, W)


class Compositor(ABC):
    """Compositing of one :func:`kgs.composite`, forward and backward, on tile lists that its constructor makes.

    `kgs.stages` wraps it in the one autograd function. Autograd records none of its methods.

    Args:
        projected: M visible pairs (camera, Gaussian).
        features: `(M, F)`.
        options: `tile_size` is a number.
        median_depth: whether the median depth is wanted.
        chunk_size: entries of a tile in a chunk of the torch backend; None chooses.

    Raises:
        ValueError: the list of one row of tiles does not fit into `max_bytes`.
    """

    @abstractmethod
    def __init__(
        self,
        projected: ProjectedGaussians,
        features: Tensor,
        options: RasterOptions,
        median_depth: bool = False,
        chunk_size: int | None = None,
    ) -> None: ...

    @abstractmethod
    def forward(self, inputs: Inputs, keep: bool) -> Images:
        """Features, transmittance and median depth of all pixels.

        With `keep` it keeps for `backward` what there is memory for.
        """

    @abstractmethod
    def backward(
        self, inputs: Inputs, grad_features: Tensor, grad_transmittance: Tensor, needs: tuple[bool, ...]
    ) -> tuple[tuple[Tensor | None, ...], Tensor | None]:
        """The gradients of the inputs, None for those that are not needed; and the sums of absolute values, or None.

        The latter, `(M, 2)`, are those of :class:`kgs.RasterOptions`, made where `options.absgrad` asks for them and a
        gradient of means2d is needed. What `forward` kept is freed; a second backward pass computes it again.
        """


class Blend(Protocol):
    """The last stage of a render."""

    def __call__(self, image: Tensor, transmittance: Tensor, background: Tensor) -> Tensor:
        """The image `(C, D, H, W)` plus the transmittance `(C, 1, H, W)` times the background.

        The background is `(D, 1, 1)`, or of any shape that can be expanded to the image's. Where the transmittance is
        0 nothing is added, of an infinite background too.
        """


class Loss(Protocol):
    """The value of :func:`kgs.losses.photometric_loss`."""

    def __call__(
        self,
        image: Tensor,
        target: Tensor,
        mean: Tensor,
        variance: Tensor,
        taps: list[float],
        dssim_weight: float,
        keep: bool,
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """L1 + `dssim_weight` (1 - SSIM), 0-d, and with `keep` what `LossGradient` needs; without a graph.

        Images are `(B, C, H, W)`, H and W at least the window; `mean` and `variance` `(1, B C, H, W)` those of the
        target under the window with these taps.
        """


class LossGradient(Protocol):
    """The gradient of :func:`kgs.losses.photometric_loss`."""

    def __call__(self, kept: tuple[Tensor, ...], taps: list[float], dssim_weight: float, grad: Tensor) -> Tensor:
        """From the gradient of the loss, 0-d, to that of the image; what `Loss` kept stays as it is."""


class LocalMoments(Protocol):
    """The moments of :func:`kgs.losses.target_moments`."""

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


class AdamStep(Protocol):
    """A step of `kgs.fit.adam.Adam`."""

    def __call__(self, updates: list[AdamUpdate], betas: tuple[float, float], eps: float) -> None:
        """Change parameters and moments in place."""


class AddGradientNorms(Protocol):
    """The statistics of :meth:`kgs.Densifier.observe`."""

    def __call__(self, sums: Tensor, counts: Tensor, ids: Tensor, gradient: Tensor, scale: tuple[float, float]) -> None:
        """Add the norms of gradients `(M, 2)`, times a scale in x and y, to `sums`, `(N,)`, and 1 to `counts`, `(N,)`.

        `ids`, `(M,)`, are the rows, each there once at most.
        """


class DecayOpacity(Protocol):
    """The decay of :meth:`kgs.Densifier.decay_opacity`."""

    def __call__(self, logits: Tensor, factor: float) -> None:
        """Multiply the opacities with these logits, `(N,)`, contiguous, by a factor in (0, 1)."""
