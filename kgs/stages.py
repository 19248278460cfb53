"""The two stages of a render, `project` and `composite`: arguments are checked here, and a backend does the work."""

import functools
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from kgs._support.autograd import refuse_second_derivative
from kgs._support.checks import check_kind, check_tensor
from kgs._support.errors import ArgumentError

from .backends import Backend, get_backend
from .backends.signatures import Compositor, Images
from .geometry.cameras import Cameras, image_size, intrinsics, with_constant_last_rows
from .geometry.projection import with_options
from .geometry.types import Composited, Gaussians, ProjectedGaussians, RasterOptions, raster_options

F = TypeVar("F", bound=Callable[..., Any])


def outside_graphs(stage: F) -> F:
    """A stage that `torch.compile` runs outside its graphs: shapes of results depend on values of tensors."""

    @functools.wraps(stage)
    def run(*args: Any, **kwargs: Any) -> Any:
        if not torch.compiler.is_compiling():
            return stage(*args, **kwargs)
        return torch.compiler.disable(stage)(*args, **kwargs)

    return run  # type: ignore[return-value]


@outside_graphs
def project(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    options: RasterOptions | None = None,
    colors: bool = True,
    backend: str | Backend = "auto",
) -> ProjectedGaussians:
    """Project Gaussians into every camera of a batch.

    Differentiable once, by `backward`, with respect to all Gaussian parameters, extrinsics and intrinsics.

    Convention:
        World-to-camera extrinsics, OpenCV axes, pixels with integer centres.

    Args:
        gaussians: N Gaussians.
        cameras: C cameras of one image size, a `PinholeCamera` or a `PosedCamera`. The third row of a pinhole camera's
            intrinsics is (0, 0, 1): a constant, without gradient.
        options: None for the defaults. near_plane, far_plane, radius_clip, eps2d, antialiased, frame and
            alpha_threshold matter here (at a threshold of 0 all Gaussians in front of the camera are visible).
        colors: whether colours are computed.
        backend: "auto", or the name of one, see `kgs.backends`.

    Returns:
        The visible pairs (camera, Gaussian): those that would touch the image with an opacity of 2, or with the largest
        of all opacities if that is more. (Their own opacity is ignored, so that a dropped Gaussian counts as visible.)

    Raises:
        TypeError: `gaussians`, `cameras` or `options` are of another type, dtype or device.
        ValueError: an option is out of range, cameras of different image sizes, intrinsics whose third row is not
            (0, 0, 1), or opacities `(C, N)` for another number of cameras.
    """
    options = raster_options(options, {})
    check_kind("gaussians", gaussians, Gaussians)
    size = image_size(cameras)
    for matrix in (cameras.extrinsics, intrinsics(cameras)):
        check_tensor("cameras", matrix, gaussians.means, " as the Gaussians")
    n = len(gaussians)
    count = cameras.extrinsics.shape[0]
    shape = tuple(gaussians.opacities.shape)
    if shape[:-1] not in ((), (count,)):
        raise ArgumentError("opacities", f"shape ({n},) or ({count}, {n}) for {count} cameras", shape)
    cameras = with_constant_last_rows(cameras)
    chosen = get_backend(backend, gaussians.means.device).covering("projection", gaussians.means)
    return with_options(chosen.project(gaussians, cameras, size, options, colors), options)


def composite(
    projected: ProjectedGaussians,
    features: Tensor,
    *,
    options: RasterOptions | None = None,
    median_depth: bool = False,
    chunk_size: int | None = None,
    backend: str | Backend = "auto",
) -> Composited:
    """Composite features of projected Gaussians over all pixels of all cameras.

    Differentiable once, by `backward`, with respect to `features` and `projected.means2d`, `factors` and `opacities`.
    `kgs.backends.torch` has the equations.

    Args:
        projected: M visible pairs (camera, Gaussian).
        features: what to accumulate, `(M, F)`: colours, depths, anything.
        options: None for the defaults. Only tile_size, alpha_threshold, transmittance_stop, max_bytes and absgrad
            matter here.
        median_depth: also return the depth at which the transmittance falls below one half.
        chunk_size: entries of a tile in a chunk of the torch backend; None chooses by the length of the lists.
        backend: "auto", or the name of one, see `kgs.backends`.

    Returns:
        Features `(C, F, H, W)` without background, transmittance and median depth (or None), each `(C, 1, H, W)`.

    Raises:
        TypeError: an argument has another type, dtype or device.
        ValueError: an option is out of range, shapes do not fit, or one row of tiles alone exceeds `max_bytes`.

    Examples:
        >>> import torch, kgs
        >>> gaussians = kgs.Gaussians(
        ...     means=torch.tensor([[0.0, 0.0, 2.0]]), quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        ...     scales=torch.full((1, 3), 0.2), opacities=torch.tensor([0.9]), colors=torch.zeros(1, 3))
        >>> k = torch.tensor([[20.0, 0.0, 15.5], [0.0, 20.0, 11.5], [0.0, 0.0, 1.0]])
        >>> projected = kgs.project(gaussians, kgs.pinhole_cameras(torch.eye(4), k, width=32, height=24))
        >>> kgs.composite(projected, torch.rand(len(projected), 8)).features.shape
        torch.Size([1, 8, 24, 32])
    """
    options = raster_options(options, {})
    if chunk_size is not None and (not isinstance(chunk_size, int | np.integer) or chunk_size < 1):
        raise ArgumentError("chunk_size", "an integer >= 1 or None", chunk_size)
    check_kind("projected", projected, ProjectedGaussians)
    _check_projected(projected, features)
    chosen = get_backend(backend, features.device)
    return rasterize(projected, features, options, chosen, median_depth=median_depth, chunk_size=chunk_size)


@outside_graphs
def rasterize(
    projected: ProjectedGaussians,
    features: Tensor,
    options: RasterOptions,
    backend: Backend,
    *,
    median_depth: bool = False,
    chunk_size: int | None = None,
    absgrad_hook: Callable[[Tensor], None] | None = None,
) -> Composited:
    """:func:`composite` of arguments that fit; a hook takes the absolute gradients in place of `means2d.absgrad`."""
    backend = backend.covering_compositing(projected, features, options, chunk_size)
    tile_size = options.tile_size or backend.tile_size
    compositor = backend.compositor(projected, features, _with_tile_size(options, tile_size), median_depth, chunk_size)
    inputs = (projected.means2d, projected.factors, projected.opacities, features)
    keep = torch.is_grad_enabled() and any(x.requires_grad for x in inputs)
    hook = absgrad_hook or _setter(projected.means2d)
    sums, transmittance, median = _Composite.apply(*inputs, compositor, keep, hook)
    return Composited(sums, transmittance, median if median_depth else None, tile_size)


def blend(
    image: Tensor, transmittance: Tensor, background: Tensor | None, backend: Backend, name: str = "background"
) -> Tensor:
    """The image `(C, D, H, W)` over a background, seen through the transmittance `(C, 1, H, W)`."""
    if background is None:
        return image
    check_tensor(name, background, image, " as the image")
    full = tuple(image.shape)
    shape = tuple(background.shape)
    if shape in (full[1:2], full[:2]):
        background = background.reshape(*shape, 1, 1)
    elif shape not in (full[1:], full):
        raise ArgumentError(name, f"shape {full[1:2]}, {full[:2]}, {full[1:]} or {full}", shape)
    return backend.covering("blending", image).blend(image, transmittance, background)


@functools.lru_cache
def _with_tile_size(options: RasterOptions, tile_size: int) -> RasterOptions:
    return replace(options, tile_size=tile_size)


def _setter(means2d: Tensor) -> Callable[[Tensor], None]:
    """A function that sets `means2d.absgrad`."""
    # of this very tensor: graphs with hooks on saved tensors give back another; it has a graph that has this function
    given = weakref.ref(means2d)

    def set_absgrad(absgrad: Tensor) -> None:
        if (tensor := given()) is not None:
            tensor.absgrad = absgrad  # type: ignore[attr-defined]

    return set_absgrad


def _check_projected(projected: ProjectedGaussians, features: Tensor) -> None:
    """Raise a TypeError or ValueError unless the inputs of compositing match."""
    check_tensor("features", features)
    m = len(projected)
    like = projected.means2d
    if features.ndim != 2 or len(features) != m:
        got = tuple(features.shape)
        raise ArgumentError("features", f"shape ({m}, F), a row per projected Gaussian", got)
    values = {name: getattr(projected, name) for name in ("means2d", "factors", "opacities", "depths")}
    shapes = {"means2d": (m, 2), "factors": (m, 2, 3), "opacities": (m,), "depths": (m,), "features": features.shape}
    for name, value in (values | {"features": features}).items():
        check_tensor(name, value, like, " as means2d")
        if tuple(value.shape) != tuple(shapes[name]):
            raise ArgumentError(name, f"shape {shapes[name]}", tuple(value.shape))
    ids = projected.camera_ids
    if ids.dtype != torch.int64 or ids.device != like.device:
        raise TypeError(f"camera_ids: expected int64 on {like.device}, got {ids.dtype} on {ids.device}")
    if tuple(ids.shape) != (m,):
        raise ArgumentError("camera_ids", f"shape {(m,)}", tuple(ids.shape))
    if m and ids.device.type == "cpu" and not torch.compiler.is_compiling():  # on a GPU this would synchronise
        first = int(np.min(ids.numpy()))
        last = int(np.max(ids.numpy()))
        if first < 0 or last >= projected.num_cameras:
            wrong = first if first < 0 else last
            raise ArgumentError("camera_ids", f"0 to {projected.num_cameras - 1}", wrong)


class _Composite(torch.autograd.Function):
    """Compositing of any backend."""

    @staticmethod
    def forward(
        means2d: Tensor,
        factors: Tensor,
        opacities: Tensor,
        features: Tensor,
        compositor: Compositor,
        keep: bool,
        absgrad_hook: Callable[[Tensor], None],
    ) -> Images:
        return compositor.forward((means2d, factors, opacities, features), keep)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Images) -> None:
        *tensors, ctx.compositor, _, ctx.absgrad_hook = inputs
        ctx.set_materialize_grads(False)
        ctx.shapes = [x.shape for x in output]
        ctx.save_for_backward(*tensors)
        ctx.mark_non_differentiable(output[2])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        refuse_second_derivative("composite")
        inputs = ctx.saved_tensors
        sums, transmittance = (inputs[3].new_zeros(ctx.shapes[i]) if grads[i] is None else grads[i] for i in range(2))
        gradients, absgrad = ctx.compositor.backward(inputs, sums, transmittance, ctx.needs_input_grad[:4])
        if absgrad is not None:
            ctx.absgrad_hook(absgrad)
        return *gradients, None, None, None
