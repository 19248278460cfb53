"""What a training step compares its render with: an image, its SSIM statistics, its transparency and its border."""

import math
from typing import Any, NamedTuple, Self

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.memory import empty
from kgs.backends import Backend
from kgs.datasets.scene import Scene, Views
from kgs.geometry.cameras import to
from kgs.losses import TargetMoments, target_moments

_ABOVE_ONE = 1.0 + 2.0**-23  # the next float32: the gradient passes at 1, as it does in torch


class Target(NamedTuple):
    """One view on the device of a fit."""

    camera: PinholeCamera
    image: Tensor  # (1, 3, H, W)
    moments: TargetMoments
    background_weight: Tensor | None  # (1, 1, H, W), the share of the background in each pixel; None: 0 everywhere
    background: Tensor  # (3,), the background that `image` has
    gains: Tensor | None  # (3, 1, 1), the factors of the scene's colours in the photo; None: 1
    mask: Tensor | None  # (H, W), that of the dark border, and 0 where no pixel counts; None: 1 everywhere

    def as_photographed(self, render: Tensor) -> Tensor:
        """A render as the photo would show it: exposed, clamped to 1, behind its border, black where nothing counts."""
        exposed = render if self.gains is None else render * self.gains
        image: Tensor = _AtMostOne.apply(exposed)  # it is never below 0
        return image if self.mask is None else image * self.mask

    def background_before_gain(self, background: Tensor | None) -> Tensor | None:
        """The background to render with, so that :meth:`as_photographed` shows this one, `(3,)`."""
        return background if self.gains is None or background is None else background / self.gains[:, 0, 0]

    def over_background(self, background: Tensor, backend: Backend) -> Self:
        """The view over another background, `(3,)`, with moments by the backend of the loss."""
        if self.background_weight is None:
            return self
        image = self.image + self.background_weight * (background - self.background)[:, None, None]
        return self._replace(image=image, moments=target_moments(image, backend=backend), background=background)


class _AtMostOne(torch.autograd.Function):
    """`clamp(max=1)` in memory of `kgs._support.memory`, where torch makes two more images in the backward pass."""

    @staticmethod
    def forward(image: Tensor) -> Tensor:
        return torch.clamp(image, max=1.0, out=empty(tuple(image.shape), image))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (image,) = ctx.saved_tensors
        result = empty(tuple(image.shape), image)
        torch.ops.aten.hardtanh_backward(grad, image, -math.inf, _ABOVE_ONE, grad_input=result)
        return result


def background_of(scene: Scene, device: torch.device) -> Tensor | None:
    """The background of a scene for the renderer, `(3,)`, or None for black."""
    return scene.background.to(device, torch.float32) if scene.background.any() else None


def targets(views: Views, background: Tensor, device: torch.device) -> list[Target]:
    """The targets of the views of a scene with this background, `(3,)`."""
    made = []
    for i, photo in enumerate(views.images):
        image = photo[None].to(device, torch.float32)
        background_weight = None if views.alphas is None else 1.0 - views.alphas[i][None].to(image)
        mask = None if views.border_mask is None else views.border_mask.to(image)
        if views.valid_mask is not None:
            valid = views.valid_mask[i].to(image)
            image = image * valid
            background_weight = None if background_weight is None else background_weight * valid
            mask = valid if mask is None else mask * valid
        made.append(
            Target(
                camera=to(views.camera(i), device),
                image=image,
                moments=target_moments(image),
                background_weight=background_weight,
                background=background.to(image),
                gains=None if views.gains is None else views.gains[i, :, None, None].to(image),
                mask=mask,
            )
        )
    return made
