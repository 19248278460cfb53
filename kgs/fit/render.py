"""Pictures of a splat from the cameras of a scene."""

from pathlib import Path

import torch

from kgs.camera import move_camera
from kgs.datasets.scene import Scene
from kgs.ply import load_ply
from kgs.renderer import GaussianRenderer

from .config import Recipe
from .outputs import check_folder, png_names, write_png
from .progress import each
from .starts import typical_depths


@torch.no_grad()
def render_views(ply: Path, scene: Scene, out: Path, device: str = "cpu") -> int:
    """Render a PLY from all cameras of a scene into `out`, one PNG per view; returns how many.

    The near plane is the recipe's, from the depths of the Gaussians themselves.
    """
    model = load_ply(ply, origin=scene.offset)
    near_plane = Recipe().near_plane * typical_depths(scene.train, model.means)[0]
    names = png_names([*scene.train.names, *scene.test.names])
    check_folder(out, names.values(), scene.root)
    renderer = GaussianRenderer(near_plane=near_plane).eval()
    model, background = model.to(device), scene.background.to(device)
    cameras = [(name, views.camera(i)) for views in (scene.train, scene.test) for i, name in enumerate(views.names)]
    for name, camera in each(cameras, "pictures", "view"):
        image = renderer(model(), move_camera(camera, torch.device(device)), background).image[0]
        write_png(out / names[name], image)
    return len(names)
