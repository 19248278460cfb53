"""The renderer: projection, binning and compositing behind one `nn.Module`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .camera import Cameras
from .projection import project
from .raster import check_options, composite
from .types import Gaussians, Rendering

__all__ = ["GaussianRenderer"]

_OUTPUTS = ("image", "alpha", "depth", "median_depth")


class GaussianRenderer(nn.Module):
    """Render 3D Gaussians with Kornia cameras, differentiable in everything: Gaussians, poses, intrinsics, background.

    Convention:
        World-to-camera extrinsics, OpenCV axes, pixels with integer centres (a centred image has cx = (W - 1) / 2).

    Args:
        opacity_layer: applied to the opacities before anything else, e.g. `DropGaussian`; None leaves them.
        tile_size: side of a tile in pixels; the speed depends on it, the image only by rounding (float32: about 1e-6 at
            16, growing with the square).
        near_plane: Gaussians with z <= near_plane are left out; in world units.
        eps2d: variance in px^2 added to each footprint, the low-pass filter of 3D Gaussian splatting.
        alpha_threshold: alphas below it are skipped. The knob that trades accuracy for time: 0 is exact.
        transmittance_stop: a pixel is done when less light than this is left.
        max_bytes: bound for the working memory of one call.

    Raises:
        ValueError: an option is out of range.

    Example:
        >>> import torch, kgs
        >>> from kornia.geometry.camera import PinholeCamera
        >>> k = torch.eye(4)[None]; k[0, 0, 0] = k[0, 1, 1] = 20.0; k[0, 0, 2], k[0, 1, 2] = 15.5, 11.5
        >>> camera = PinholeCamera(k, torch.eye(4)[None], torch.tensor([24]), torch.tensor([32]))
        >>> gaussians = kgs.Gaussians(
        ...     means=torch.tensor([[0.0, 0.0, 2.0]]), quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        ...     scales=torch.full((1, 3), 0.2), opacities=torch.tensor([0.9]), colors=torch.tensor([[1.0, 0.5, 0.0]]))
        >>> kgs.GaussianRenderer()(gaussians, camera).image.shape
        torch.Size([1, 3, 24, 32])
    """

    def __init__(
        self,
        opacity_layer: nn.Module | None = None,
        tile_size: int = 8,
        near_plane: float = 0.01,
        eps2d: float = 0.3,
        alpha_threshold: float = 1 / 255,
        transmittance_stop: float = 1e-4,
        max_bytes: int = 2**30,
    ) -> None:
        super().__init__()
        check_options(tile_size, alpha_threshold, transmittance_stop, None)
        for name, value in (("near_plane", near_plane), ("eps2d", eps2d)):
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name}: expected a finite number >= 0, got {value}")
        self.opacity_layer = nn.Identity() if opacity_layer is None else opacity_layer
        self.tile_size = tile_size
        self.near_plane = near_plane
        self.eps2d = eps2d
        self.alpha_threshold = alpha_threshold
        self.transmittance_stop = transmittance_stop
        self.max_bytes = max_bytes

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
            background: None for black, or `(3,)`, `(C, 3)` or `(C, 3, H, W)`.
            outputs: any of "image", "alpha", "depth", "median_depth"; what is not named is not computed.

        Returns:
            The outputs asked for, and the Gaussians that were seen.

        Raises:
            TypeError: an argument has another type or dtype.
            ValueError: an unknown output, or shapes that do not fit.
        """
        wanted = _check_outputs(outputs)
        if not isinstance(gaussians, Gaussians):
            raise TypeError(f"gaussians: expected kgs.Gaussians, got {type(gaussians).__name__}")
        opacities = self.opacity_layer(gaussians.opacities)
        if opacities is not gaussians.opacities:
            gaussians = Gaussians(gaussians.means, gaussians.quats, gaussians.scales, opacities, gaussians.colors)
        projected = project(
            gaussians,
            cameras,
            near_plane=self.near_plane,
            eps2d=self.eps2d,
            alpha_threshold=self.alpha_threshold,
            colors="image" in wanted,
        )
        if projected.means2d.requires_grad:
            projected.means2d.retain_grad()
        features = projected.colors
        if "depth" in wanted:
            features = torch.cat([features, projected.depths[:, None]], 1)
        result = composite(
            projected,
            features,
            tile_size=self.tile_size,
            alpha_threshold=self.alpha_threshold,
            transmittance_stop=self.transmittance_stop,
            median_depth="median_depth" in wanted,
            max_bytes=self.max_bytes,
        )
        alpha = 1.0 - result.transmittance
        image = depth = None
        if "image" in wanted:
            image = result.features[:, :3]
            if background is not None:
                image = image + result.transmittance * _check_background(background, image)
        if "depth" in wanted:
            covered = alpha >= 1e-6
            depth = torch.where(covered, result.features[:, -1:] / torch.where(covered, alpha, 1.0), 0.0)
        return Rendering(
            image=image,
            alpha=alpha if "alpha" in wanted else None,
            depth=depth,
            median_depth=result.median_depth,
            projected=projected,
        )

    def extra_repr(self) -> str:
        """What `print` shows."""
        return (
            f"tile_size={self.tile_size}, near_plane={self.near_plane:g}, eps2d={self.eps2d:g}, "
            f"alpha_threshold={self.alpha_threshold:g}, transmittance_stop={self.transmittance_stop:g}"
        )


def _check_outputs(outputs: Sequence[str]) -> set[str]:
    if isinstance(outputs, str) or not outputs or set(outputs) - set(_OUTPUTS):
        raise ValueError(f"outputs: expected some of {_OUTPUTS}, got {outputs!r}")
    return set(outputs)


def _check_background(background: Tensor, image: Tensor) -> Tensor:
    cameras = image.shape[0]
    if not isinstance(background, Tensor):
        raise TypeError(f"background: expected a torch.Tensor or None, got {type(background).__name__}")
    if background.dtype != image.dtype or background.device != image.device:
        raise TypeError(
            f"background: expected {image.dtype} on {image.device}, got {background.dtype} on {background.device}"
        )
    shape = tuple(background.shape)
    if shape in ((3,), (cameras, 3)):
        return background.reshape(-1, 3, 1, 1)
    if shape == tuple(image.shape):
        return background
    raise ValueError(f"background: expected shape (3,), ({cameras}, 3) or {tuple(image.shape)}, got {shape}")
