"""What there is to time on one scene: renders, training steps, their stages, and what is saved by asking for less."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.camera import move_camera
from kgs.losses import photometric_loss, target_moments
from kgs.model import GaussianModel
from kgs.projection import project
from kgs.raster import composite
from kgs.raster.tiles import bin_to_tiles
from kgs.renderer import GaussianRenderer
from kgs.types import Gaussians

from .scenes import layered_scene

__all__ = ["Cases"]


class Cases:
    """One scene, and what there is to time on it."""

    def __init__(self, count: int, size: tuple[int, int], device: torch.device) -> None:
        model, camera = layered_scene(count, size)
        self.count, self.device = count, device
        self.model: GaussianModel = model.to(device)
        self.camera: PinholeCamera = move_camera(camera, device)
        self.renderer = GaussianRenderer()
        generator = torch.Generator().manual_seed(0)
        self.weights = torch.rand(1, 3, *size, generator=generator).to(device) / math.prod(size)
        self.photo = torch.rand(1, 3, *size, generator=generator).to(device)
        self.moments = target_moments(self.photo)
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=0.0, fused=True)
        with torch.no_grad():
            bins = bin_to_tiles(project(self.model(), self.camera))
        self.pairs = bins.entries.shape[0] * bins.tile_size**2 / 1e6

    def main(self) -> dict[str, Callable[[], object]]:
        """The lines of the main table."""
        return {
            "forward, no gradient": self.forward,
            "forward + backward": lambda: self.both(self.model()),
            "training step": self.train,
        }

    def forward(self) -> Tensor:
        """Render without gradient."""
        with torch.no_grad():
            image: Tensor = self.renderer(self.model(), self.camera).image
        return image

    def both(self, gaussians: Gaussians, outputs: tuple[str, ...] = ("image",)) -> None:
        """Render, and go back to all parameters that the Gaussians hang on."""
        rendering = self.renderer(gaussians, self.camera, outputs=outputs)
        picture = rendering.image if rendering.image is not None else rendering.alpha
        (picture * self.weights[:, : picture.shape[1]]).sum().backward()
        self.model.zero_grad()

    def train(self) -> None:
        """One step of training, densification left aside."""
        image = self.renderer(self.model(), self.camera).image
        photometric_loss(image.clamp(0, 1), self.photo, 0.2, moments=self.moments).backward()
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def stages(self) -> dict[str, Callable[[], object]]:
        """The parts of a training step one by one; each keeps what the next one needs."""
        kept: dict[str, Any] = {}

        def projection() -> None:
            kept["projected"] = project(self.model(), self.camera)
            p = kept["projected"]
            kept["inputs"] = [x.detach().requires_grad_() for x in (p.means2d, p.factors, p.opacities, p.colors)]

        def binning() -> None:
            bin_to_tiles(kept["projected"])

        def forward() -> None:
            names = ("means2d", "factors", "opacities", "colors")
            loose = replace(kept["projected"], **dict(zip(names, kept["inputs"], strict=True)))
            kept["image"] = composite(loose, loose.colors).features

        def loss() -> None:
            image = kept["image"].detach().requires_grad_()
            photometric_loss(image.clamp(0, 1), self.photo, 0.2, moments=self.moments).backward()
            kept["grad"] = image.grad

        def backward() -> None:
            kept["grads"] = torch.autograd.grad(kept["image"], kept["inputs"], kept["grad"])

        def projection_backward() -> None:
            p = kept["projected"]
            torch.autograd.backward([p.means2d, p.factors, p.opacities, p.colors], kept["grads"])

        def adam() -> None:
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)

        return {
            "projection, harmonics": projection,
            "binning": binning,
            "compositing, binning included": forward,
            "loss, forward + backward": loss,
            "compositing, backward": backward,
            "projection, harmonics, backward": projection_backward,
            "Adam": adam,
        }

    def savings(self) -> dict[str, Callable[[], object]]:
        """Forward + backward with one thing less each time."""

        def changed(**fields: Tensor) -> Gaussians:
            return Gaussians(**{**vars(self.model()), **fields})

        half = (torch.arange(self.count, device=self.device) % 2).float()
        behind = torch.tensor([0.0, 0.0, -100.0], device=self.device)
        return {
            "everything": lambda: self.both(self.model()),
            "no gradient at all": self.forward,
            "colours frozen": lambda: self.both(changed(colors=self.model().colors.detach())),
            "geometry frozen": lambda: self.both(
                changed(
                    means=self.model.means.detach(),
                    quats=self.model.quats.detach(),
                    scales=self.model.log_scales.detach().exp(),
                )
            ),
            "all but colours frozen": lambda: self.both(
                Gaussians(**{name: x if name == "colors" else x.detach() for name, x in vars(self.model()).items()})
            ),
            "harmonics of degree 0": lambda: self.both(changed(colors=self.model.sh_dc)),
            "alpha only": lambda: self.both(self.model(), ("alpha",)),
            "half of the Gaussians dropped": lambda: self.both(changed(opacities=self.model().opacities * half)),
            "half of the Gaussians behind the camera": lambda: self.both(
                changed(means=self.model.means + behind * (1 - half)[:, None])
            ),
        }
