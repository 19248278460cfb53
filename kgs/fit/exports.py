"""Writes the results of a fit for other programs, besides its PLY file: cameras, glTF, a film."""

from pathlib import Path

from kgs.geometry import typical_depths
from kgs.io.cameras import camera_list, rolled, upright
from kgs.io.console import each
from kgs.io.encoders import film_suffix
from kgs.io.film import write_film
from kgs.io.glb import save_glb
from kgs.io.outputs import FILMS
from kgs.io.ownership import is_own
from kgs.json_files import write_json

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
    suffix, note = film_suffix()
    for path in (folder / name for name in FILMS):
        if path.suffix != suffix:
            if is_own(path):  # of a former run, with another encoder
                path.unlink()
        elif why := write_film(path, trainer.render, upright_views, depth, each):
            trainer.note(why)
    if note:
        trainer.note(note)
