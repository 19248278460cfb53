"""A backend is a table of stages, and one rule says where torch takes its place."""

import functools
import importlib.util
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from kgs._support.errors import ArgumentError
from kgs._support.torch_threads import torch_on_one_thread
from kgs.geometry.types import ProjectedGaussians, RasterOptions

from .signatures import (
    Activate,
    AdamStep,
    AddGradientNorms,
    Blend,
    Compositor,
    DecayOpacity,
    LocalMoments,
    Loss,
    LossGradient,
    Project,
)
from .torch import activation, blending, projection
from .torch.compositing import TorchCompositor


class Lazy:
    """A function, "module:name", whose module is imported when it is first called."""

    def __init__(self, path: str) -> None:
        self._path = path

    @functools.cached_property
    def _function(self) -> Any:
        module, _, name = self._path.partition(":")
        return getattr(import_module(module), name)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """What the function returns."""
        return self._function(*args, **kwargs)


def _always(device: torch.device) -> bool:
    return True


def _nothing_to_compile(run: Callable[[torch.device], object], device: torch.device) -> None:
    return


@dataclass(frozen=True, eq=False, repr=False)
class Backend:
    """An implementation of the renderer and of the other heavy stages of a fit, see `kgs.backends.signatures`.

    A stage that a backend does not have is torch's. Torch defines what is right; others give the same within rounding.

    Attributes:
        name: what `backend=` calls it.
        devices: the types of torch devices it runs on; None for all.
        dtypes: of the tensors it works on.
        package: what must be installed beside torch, and how to install it; None for nothing.
        is_trusted: whether "auto" may take it on a device. The first call may take seconds, and say in a line why not.
        compile_ahead: compiles what a piece of code needs on a device, all at once, and reports no error. The code
            calls stages of this backend, with tensors of the device that it is given.
        tile_size: side of its tiles in pixels, where `RasterOptions.tile_size` is None.
        max_width: of images that it composites, in pixels.
        max_absgrad_features: how many features it composites with `RasterOptions.absgrad`.
        has_torch_on_one_thread: whether torch runs on one thread beside it, see `kgs._support.torch_threads`.
        is_named: whether the user asked for it by name: then :meth:`covering` refuses what it does not cover. A stage
            may still call torch for a part of its cases, as other lenses.
        activate, project, compositor, blend: the stages of a render.
        loss, loss_gradient, local_moments: of the photometric loss; None where `kgs.losses` computes it in torch.
        adam_step, add_gradient_norms, decay_opacity: of what a fit does with gradients, in place: all three, or None
            where `kgs.fit.adam` and `kgs.densify` do it in torch.
    """

    name: str
    devices: tuple[str, ...] | None = None
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64)
    package: tuple[str, str] | None = None
    is_trusted: Callable[[torch.device], bool] = _always
    compile_ahead: Callable[[Callable[[torch.device], object], torch.device], None] = _nothing_to_compile
    tile_size: int = 8
    max_width: float = float("inf")
    max_absgrad_features: float = float("inf")
    has_torch_on_one_thread: bool = False
    is_named: bool = False

    activate: Activate = activation.activate
    project: Project = projection.project
    compositor: Callable[..., Compositor] = TorchCompositor
    blend: Blend = blending.blend
    loss: Loss | None = None
    loss_gradient: LossGradient | None = None
    local_moments: LocalMoments | None = None
    adam_step: AdamStep | None = None
    add_gradient_norms: AddGradientNorms | None = None
    decay_opacity: DecayOpacity | None = None

    def is_installed(self) -> bool:
        """Whether the package it needs is there; does not import it."""
        return self.package is None or _is_found(self.package[0])

    def runs_on(self, device: torch.device) -> bool:
        """Whether it runs on such a device."""
        return self.devices is None or device.type in self.devices

    def beside(self) -> AbstractContextManager[None]:
        """For a fit with this backend: limits torch to one thread where kernels on a CPU do most of the work."""
        return torch_on_one_thread() if self.has_torch_on_one_thread else nullcontext()

    def covering(self, stage: str, like: Tensor, fits: bool = True) -> "Backend":
        """This backend where it covers a call, and torch's otherwise.

        A graph that is being traced has no kernels.

        Args:
            stage: what is to be done, for the error.
            like: a tensor of the call; its dtype and device count, its values are not read.
            fits: whether it covers what else is asked for.

        Raises:
            TypeError: the tensor is neither float32 nor float64.
            ValueError: the backend was asked for by name, and does not cover the call.
        """
        if like.dtype not in TORCH.dtypes:
            raise TypeError(f"{stage}: expected tensors of float32 or float64, got {like.dtype}")
        if self.name == TORCH.name:
            return self
        if fits and like.dtype in self.dtypes and self.runs_on(like.device) and not torch.compiler.is_compiling():
            return self
        if self.is_named:
            raise ArgumentError("backend", f'"auto" or "torch" for this call of {stage}', f'"{self.name}"')
        return TORCH

    def covering_compositing(
        self, projected: ProjectedGaussians, features: Tensor, options: RasterOptions, chunk_size: int | None
    ) -> "Backend":
        """:meth:`covering` of a call of :func:`kgs.composite`."""
        of_tiles = options.tile_size in (None, self.tile_size) and chunk_size is None
        of_absgrad = not options.absgrad or features.shape[1] <= self.max_absgrad_features
        fits = of_tiles and of_absgrad and projected.image_size[1] <= self.max_width
        return self.covering("compositing", features, fits)


TORCH = Backend("torch")


@functools.cache
def _is_found(package: str) -> bool:
    return importlib.util.find_spec(package) is not None
