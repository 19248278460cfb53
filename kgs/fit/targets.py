"""What a training step compares its render with: an image, its SSIM statistics, its transparency and its border."""

from typing import NamedTuple

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.camera import move_camera
from kgs.datasets.scene import Views
from kgs.losses import TargetMoments, target_moments


class Target(NamedTuple):
    """One view on the device of a fit."""

    camera: PinholeCamera
    image: Tensor  # (1, 3, H, W)
    moments: TargetMoments
    clear: Tensor | None  # (1, 1, H, W), the share of the background in each pixel; None: 0 everywhere
    background: Tensor  # (3,), the background that `image` has
    light: Tensor | None  # (H, W), the transmittance of a dark border; None: 1 everywhere

    def seen(self, render: Tensor) -> Tensor:
        """A render as the photo would show it: clamped to 1, and darkened by the border."""
        image = render.masked_fill(render > 1, 1.0)  # it is never below 0
        return image if self.light is None else image * self.light

    def over(self, background: Tensor) -> tuple[Tensor, TargetMoments]:
        """The image over another background, `(3,)`, and its SSIM statistics."""
        if self.clear is None:
            return self.image, self.moments
        image = self.image + self.clear * (background - self.background)[:, None, None]
        return image, target_moments(image)


def targets(views: Views, background: Tensor, device: torch.device) -> list[Target]:
    """One target for each view; `background`, `(3,)`, is that of the scene."""
    images = [image[None].to(device, torch.float32) for image in views.images]
    masks = [None] * len(views) if views.masks is None else [1.0 - mask[None].to(images[0]) for mask in views.masks]
    cameras = [move_camera(views.camera(i), device) for i in range(len(views))]
    parts = zip(cameras, images, map(target_moments, images), masks, strict=True)
    light = None if views.light is None else views.light.to(images[0])
    return [Target(*each, background.to(images[0]), light) for each in parts]
