"""What a training step compares its render with: an image, its SSIM statistics, its transparency and its border."""

from typing import NamedTuple, Self

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.camera import move_camera
from kgs.datasets.scene import Scene, Views
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
        image = render.clamp(max=1.0)  # it is never below 0
        return image if self.light is None else image * self.light

    def over(self, background: Tensor) -> Self:
        """The view before another background, `(3,)`."""
        if self.clear is None:
            return self
        image = self.image + self.clear * (background - self.background)[:, None, None]
        return self._replace(image=image, moments=target_moments(image), background=background)


def background_of(scene: Scene, device: torch.device) -> Tensor | None:
    """The background of a scene for the renderer, `(3,)`; None for black."""
    return scene.background.to(device, torch.float32) if scene.background.any() else None


def targets(views: Views, background: Tensor, device: torch.device) -> list[Target]:
    """One target for each view; `background`, `(3,)`, is that of the scene."""
    made = []
    for i, photo in enumerate(views.images):
        image = photo[None].to(device, torch.float32)
        made.append(
            Target(
                camera=move_camera(views.camera(i), device),
                image=image,
                moments=target_moments(image),
                clear=None if views.masks is None else 1.0 - views.masks[i][None].to(image),
                background=background.to(image),
                light=None if views.light is None else views.light.to(image),
            )
        )
    return made
