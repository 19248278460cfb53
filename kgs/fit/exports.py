"""Writes the results of a fit for other programs, besides its PLY file: cameras, glTF, a film."""

from pathlib import Path

from kgs.geometry import typical_depths
from kgs.io.cameras import camera_list, rolled, upright
from kgs.io.console import each
from kgs.io.film import write_film
from kgs.io.glb import save_glb
from kgs.io.json_files import write_json
from kgs.io.outputs import FILM

from .trainer import Trainer


def write_exports(trainer: Trainer, folder: Path, roll: float = 0.0) -> None:
    """Write `outputs.EXPORTS`; if there can be no film, a note of the trainer says why.

    `roll` turns the pictures of the film, and with them what is up in the glTF file, see :func:`kgs.io.cameras.rolled`.
    """
    scene, model = trainer.scene, trainer.shown
    upright_views = rolled(scene.train, roll)
    write_json(folder / "cameras.json", camera_list([scene.train, scene.test], scene.offset))
    save_glb(folder / "splat.glb", model, upright(upright_views.cameras.extrinsics), scene.offset)
    depth = typical_depths(model.means, scene.train.cameras)[1]
    if note := write_film(folder / FILM, trainer.render, upright_views, depth, each):
        trainer.note(note)
