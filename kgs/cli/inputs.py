"""What several commands load: scenes, cameras and splats."""

from pathlib import Path
from typing import Any

from kgs.errors import DataError, listed, printable
from kgs.fit.config import Recipe
from kgs.io.console import say


def load_cameras(cameras: Path, downscale: float | None, **options: Any) -> Any:
    """The scene without its photos, of which there may be hundreds; all views are training views."""
    from kgs.datasets import load_scene

    scene = load_scene(cameras, None, downscale, hold_out=0, photos=False, **options)
    for note in scene.notes:
        say(note)
    return scene


def load_splat(ply: Path, scene: Any, place: Any, backend: str) -> tuple[Any, Any]:
    """The Gaussians in the frame of the scene, and a renderer for them: its near plane, and whether it antialiases.

    A DataError if no camera of the scene sees one; single cameras that see none are named.
    """
    from kgs.geometry import typical_depths
    from kgs.io.ply import load_ply
    from kgs.renderer import GaussianRenderer

    model = load_ply(ply, origin=scene.offset)
    near_plane = Recipe().near_plane * typical_depths(model.means, scene.train.cameras)[0]
    renderer = GaussianRenderer(near_plane=near_plane, antialiased=model.antialiased, backend=backend)
    model = model.to(place)
    _check_seen(ply, model, scene, renderer)
    return model, renderer.eval()


def _check_seen(ply: Path, model: Any, scene: Any, renderer: Any) -> None:
    """Refuse a splat that no camera sees; name the cameras that see nothing of it."""
    import torch

    from kgs.camera import move_camera
    from kgs.stages import project

    blind = []
    with torch.no_grad():
        gaussians = model()
    for i, name in enumerate(scene.train.names):
        camera = move_camera(scene.train.camera(i), model.means.device)
        if not len(project(gaussians, camera, options=renderer.options, colors=False, backend=renderer.backend)):
            blind.append(name)
    if len(blind) == len(scene.train):
        reason = f"expected some that a camera of {printable(scene.root)} sees, got none of {len(model)}"
        raise DataError(ply, "Gaussians", f"{reason}: are they in the frame of these cameras?")
    if blind:
        say(f"these cameras see no Gaussian of {printable(ply)}: {listed(blind)}")
