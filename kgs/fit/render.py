"""Pictures of a splat from the cameras of a scene."""

from __future__ import annotations

from pathlib import Path

import torch

from kgs.datasets.scene import Scene
from kgs.ply import load_ply
from kgs.renderer import GaussianRenderer

from .config import Recipe
from .outputs import png_name, write_png
from .starts import typical_depths
from .trainer import move_camera

__all__ = ["render_views"]


def render_views(ply: Path, scene: Scene, out: Path, device: str = "cpu") -> int:
    """Render a PLY from all training and test cameras of a scene into `out`, one PNG a view; returns how many.

    The near plane is the recipe's, from the depths of the Gaussians themselves.

    Raises:
        DataError: the PLY is broken.
    """
    model = load_ply(ply)
    with torch.no_grad():
        model.means.sub_(scene.offset.to(model.means))
    near_plane = Recipe().near_plane * typical_depths(scene.train, model.means.detach())[0]
    renderer = GaussianRenderer(near_plane=near_plane).eval()
    out.mkdir(parents=True, exist_ok=True)
    model = model.to(device)
    background = scene.background.to(device)
    count = 0
    for views in (scene.train, scene.test):
        for i, name in enumerate(views.names):
            camera = views.camera(i)
            with torch.no_grad():
                image = renderer(model(), move_camera(camera, torch.device(device)), background).image[0]
            write_png(out / png_name(name), image)
            count += 1
    return count
