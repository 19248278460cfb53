"""What several commands load: scenes, cameras and splats."""

from pathlib import Path
from typing import Any

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
    """The Gaussians in the frame of the scene, and a renderer whose near plane follows from them."""
    from kgs.geometry import typical_depths
    from kgs.io.ply import load_ply
    from kgs.renderer import GaussianRenderer

    model = load_ply(ply, origin=scene.offset)
    near_plane = Recipe().near_plane * typical_depths(model.means, scene.train.cameras)[0]
    return model.to(place), GaussianRenderer(near_plane=near_plane, backend=backend).eval()
