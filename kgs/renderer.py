"""The renderer: projection and compositing behind one `nn.Module`."""

import dataclasses
from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Any

import torch
from torch import Tensor, nn

from kgs._support.checks import check_kind
from kgs._support.errors import ArgumentError, quoted

from .backends import Backend, check_backend, get_backend
from .geometry.cameras import Cameras
from .geometry.projection import normals
from .geometry.types import Gaussians, RasterOptions, Rendering, raster_options
from .stages import blend, outside_graphs, project, rasterize

_OUTPUTS = ("image", "alpha", "depth", "median_depth", "normal")


class GaussianRenderer(nn.Module):
    """Render 3D Gaussians with Kornia cameras, differentiable in everything: Gaussians, poses, intrinsics, background.

    Convention:
        World-to-camera extrinsics, OpenCV axes, pixels with integer centres (a centred image has cx = (W - 1) / 2).

    Limits:
        Differentiable once, by `backward` or `torch.autograd.grad`. Second derivatives, forward mode, `torch.func`
        (vmap, jacrev, jvp, ...) and `is_grads_batched` are errors. `torch.compile` breaks its graph at `project` and
        `composite`, which run as they are. Depth divides by alpha = 1 - T, which in float32 has an error of 6e-8: 6 %
        where alpha is 1e-6.

    Args:
        opacity_layer: applied to the opacities before anything else, e.g. `DropGaussian`; None leaves them.
        backend: "auto" (the fastest that covers the call), "torch", or in float32 with tiles of 8 "numba" (on a
            CPU) or "triton" (on a GPU), see `kgs.backends`.
        options: how Gaussians become pixels; None for the defaults. `renderer.options` may be replaced later.
        fields: those of :class:`kgs.RasterOptions` as keyword arguments, in place of `options`.

    Raises:
        TypeError: both `options` and fields of them are given, a field does not exist, or the layer cannot be called.
        ValueError: an option is out of range, or the backend does not exist.
        ModuleNotFoundError: the backend is numba or triton, and it is not installed.

    Examples:
        >>> import torch, kgs
        >>> k = torch.tensor([[20.0, 0.0, 15.5], [0.0, 20.0, 11.5], [0.0, 0.0, 1.0]])
        >>> camera = kgs.pinhole_cameras(torch.eye(4), k, width=32, height=24)
        >>> gaussians = kgs.Gaussians(
        ...     means=torch.tensor([[0.0, 0.0, 2.0]]), quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        ...     scales=torch.full((1, 3), 0.2), opacities=torch.tensor([0.9]), colors=torch.tensor([[1.0, 0.5, 0.0]]))
        >>> kgs.GaussianRenderer()(gaussians, camera).image.shape
        torch.Size([1, 3, 24, 32])

        A pose that is optimised: the camera is made in the loop, because a `PinholeCamera` clones what it is given.

        >>> target = kgs.GaussianRenderer()(gaussians, camera).image
        >>> shift = torch.full((3, 1), 0.1, requires_grad=True)
        >>> optimizer = torch.optim.Adam([shift], lr=0.01)
        >>> for step in range(20):
        ...     pose = torch.eye(4) + torch.nn.functional.pad(shift, (3, 0, 0, 1))
        ...     image = kgs.GaussianRenderer()(gaussians, kgs.pinhole_cameras(pose, k, width=32, height=24)).image
        ...     loss = (image - target).square().mean()
        ...     optimizer.zero_grad(); loss.backward(); optimizer.step()
        >>> bool(loss < 1e-3)
        True
    """

    def __init__(
        self,
        opacity_layer: nn.Module | None = None,
        *,
        options: RasterOptions | None = None,
        backend: str | Backend = "auto",
        **fields: Any,
    ) -> None:
        super().__init__()
        check_backend(backend)
        if opacity_layer is not None and not callable(opacity_layer):
            raise TypeError(f"opacity_layer: expected a module such as DropGaussian(p=0.2), got {opacity_layer!r}")
        self.opacity_layer: nn.Module = nn.Identity() if opacity_layer is None else opacity_layer
        self.options = raster_options(options, fields)
        self.backend = backend

    @outside_graphs
    def forward(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        background: Tensor | None = None,
        outputs: Sequence[str] = ("image",),
    ) -> Rendering:
        """Render every camera of the batch.

        Args:
            gaussians: N Gaussians.
            cameras: C cameras of one image size.
            background: None for black, or `(3,)`, `(C, 3)`, `(3, H, W)` or `(C, 3, H, W)`; D numbers for D features.
            outputs: any of "image", "alpha", "depth", "median_depth", "normal"; what is not named is not computed.

        Returns:
            The outputs asked for, and the visible Gaussians.

        Raises:
            TypeError: an argument has another type or dtype.
            ValueError: an unknown output, shapes that do not fit, `max_bytes` too small for a row of tiles, or the
                backend that is named does not cover the call.
        """
        if isinstance(outputs, str) or not (outputs := tuple(outputs)) or set(outputs) - set(_OUTPUTS):
            raise ArgumentError("outputs", f"some of {_OUTPUTS}", quoted(outputs))
        check_kind("gaussians", gaussians, Gaussians)
        opacities = self.opacity_layer(gaussians.opacities)
        if opacities is not gaussians.opacities:
            gaussians = dataclasses.replace(gaussians, opacities=opacities)
        with_image = "image" in outputs
        backend = get_backend(self.backend, opacities.device)
        projected = project(gaussians, cameras, options=self.options, colors=with_image, backend=backend)
        features = {"image": projected.colors}
        if "depth" in outputs:
            features["depth"] = projected.depths[:, None]
        if "normal" in outputs:
            features["normal"] = normals(gaussians, cameras, projected)
        values = torch.cat(list(features.values()), 1) if len(features) > 1 else projected.colors
        median = "median_depth" in outputs
        result = rasterize(projected, values, self.options, backend, median_depth=median)
        images = {"image": result.features}
        if len(features) > 1:
            ends = accumulate((x.shape[1] for x in features.values()), initial=0)
            images = {name: result.features[:, i:j] for name, (i, j) in zip(features, pairwise(ends), strict=True)}
        if "depth" in outputs:
            alpha = 1.0 - result.transmittance
            covered = alpha >= 1e-6
            images["depth"] = torch.where(covered, images["depth"] / torch.where(covered, alpha, 1.0), 0.0)
        image = None
        if with_image:
            image = blend(images["image"], result.transmittance, background, backend)
        return Rendering(
            image=image,
            alpha=1.0 - result.transmittance if "alpha" in outputs else None,
            depth=images.get("depth"),
            median_depth=result.median_depth,
            projected=projected,
            normal=images.get("normal"),
        )

    def extra_repr(self) -> str:
        """The options, as `print` displays them."""
        options = vars(self.options).items()
        texts = (f"{name}={value:g}" if isinstance(value, float) else f"{name}={value}" for name, value in options)
        return ", ".join(texts)
