"""Writes the results of a fit for other programs, besides its PLY file: cameras, glTF, a film."""

from dataclasses import replace
from pathlib import Path

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.camera import move_camera
from kgs.geometry import typical_depths
from kgs.io.cameras import camera_list, rolled, upright
from kgs.io.console import each
from kgs.io.encoders import film_suffix
from kgs.io.film import path_near_plane, write_film
from kgs.io.glb import save_glb
from kgs.io.json_files import write_json
from kgs.io.outputs import FILMS
from kgs.io.ownership import is_own
from kgs.renderer import GaussianRenderer

from .trainer import Trainer


def write_exports(trainer: Trainer, folder: Path, roll: float = 0.0) -> None:
    """Write `outputs.EXPORTS` with one of the films; if there can be none, or no MP4, notes of the trainer say why.

    `roll` turns the pictures of the film, and with them what is up in the glTF file, see :func:`kgs.io.cameras.rolled`.
    """
    scene, model = trainer.scene, trainer.shown
    upright_views = rolled(scene.train, roll)
    write_json(folder / "cameras.json", camera_list([scene.train, scene.test], scene.offset, model.means))
    save_glb(folder / "splat.glb", model, upright(upright_views.cameras.extrinsics), scene.offset)
    depth = typical_depths(model.means, scene.train.cameras)[1]
    options = trainer.renderer.options
    near_plane = path_near_plane(model.means, scene.train.cameras, options.near_plane)
    options = replace(options, near_plane=near_plane)
    renderer = GaussianRenderer(options=options, backend=trainer.backend).eval()

    @torch.no_grad()
    def render(camera: PinholeCamera) -> Tensor:
        background = scene.background.to(trainer.device, torch.float32)
        image: Tensor = renderer(model(), move_camera(camera, trainer.device), background).image
        return image

    suffix, note = film_suffix()
    for path in (folder / name for name in FILMS):
        if path.suffix != suffix:
            if is_own(path):  # of a former run, with another encoder
                path.unlink()
        elif why := write_film(path, render, upright_views, depth, each):
            trainer.note(why)
    if note:
        trainer.note(note)
