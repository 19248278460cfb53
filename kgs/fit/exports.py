"""What a fit leaves for other programs beside its PLY file: the cameras, glTF, a film."""

from pathlib import Path

from kgs.export.cameras import camera_list, upright
from kgs.export.film import write_film
from kgs.export.glb import save_glb
from kgs.json_files import write_json

from .pixels import typical_depths
from .progress import each
from .trainer import Trainer


def write_exports(trainer: Trainer, folder: Path) -> None:
    """Write `outputs.EXPORTS`; where there can be no film, the trainer's notes say why."""
    scene, model = trainer.scene, trainer.shown
    write_json(folder / "cameras.json", camera_list([scene.train, scene.test], scene.offset))
    save_glb(folder / "splat.glb", model, upright(scene.train.cameras.extrinsics), scene.offset)
    depth = typical_depths(scene.train, model.means)[1]
    if note := write_film(folder / "turntable.webm", trainer.render, scene.train, depth, each):
        trainer.notes.append(note)
