"""What several commands load: scenes, cameras and splats."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kgs._support.errors import ArgumentError, DataError, listed, printable
from kgs._support.json_files import read_json
from kgs.app.console import say
from kgs.app.scene_request import SceneRequest
from kgs.datasets.source import SceneSource
from kgs.fit.config import Recipe

from .checks import check_results

if TYPE_CHECKING:
    import torch

    from kgs.datasets.scene import Scene
    from kgs.fit.fit import Fit


def open_splat(splat: Path, cameras: Path | None) -> tuple[Path, SceneSource]:
    """The PLY file of a splat, and its scene: the one that is named, or that of the fit whose folder this is."""
    if not splat.is_dir():
        if cameras is None:
            raise ArgumentError("cameras", "the scene of the PLY file", "none")
        return splat, SceneSource(cameras)
    check_results(splat)
    if cameras is None:
        path = splat / "config.json"
        request = read_json(path).get("request")
        cameras = splat / SceneRequest.from_dict(request if isinstance(request, dict) else {}, path).scene
    return splat / "splat.ply", SceneSource(cameras)


def load_cameras(source: SceneSource, downscale: float | None = None, photos: bool = False, **options: Any) -> "Scene":
    """The scene without its photos, of which there may be hundreds, or with them; all views are training views."""
    from kgs.datasets import load_scene

    scene = load_scene(source, None, downscale, hold_out=0, photos=photos, **options)
    for note in scene.notes:
        say(note)
    return scene


def options_of_fit(ply: Path, source: SceneSource) -> dict[str, Any]:
    """How the fit that made a splat loaded the photos of a scene, as arguments of `load_scene`: their size and masks.

    Empty if the splat does not lie in the folder of a fit to this scene, and the scene is not such a folder.
    """
    from kgs.app.saved_fit import read_request

    for folder in (ply.parent, source.root):
        with suppress(DataError):  # there is no fit, or this is a file of another program
            request = read_request(folder / "config.json")
            if (folder / request.scene).resolve() == source.root.resolve():
                masks = folder / request.masks if request.masks else None
                names = ("downscale", "photo_folder", "mask_mode")
                return {**{name: getattr(request, name) for name in names}, "masks": masks}
    return {}


def load_splat(ply: Path, scene: "Scene", device: "torch.device", backend: str) -> "Fit":
    """A splat in the frame of a scene: its near plane follows from the cameras, antialiasing from the file.

    A DataError if there is no Gaussian, or no camera of the scene sees one; single cameras that see none are named.
    """
    from kgs.fit.fit import Fit
    from kgs.geometry.multiview import typical_depths
    from kgs.geometry.types import RasterOptions
    from kgs.ply import load_ply

    model = load_ply(ply, origin=scene.offset)
    if not len(model):
        raise DataError(ply, "Gaussians", "at least one", "none")
    near_plane = Recipe().near_plane * typical_depths(model.means, scene.train.cameras)[0]
    options = RasterOptions(near_plane=near_plane, antialiased=model.antialiased)
    fit = Fit(scene, model.to(device), options, backend)
    _check_seen(ply, fit)
    return fit


def _check_seen(ply: Path, fit: "Fit") -> None:
    """Refuse a splat that no camera sees; name the cameras that see nothing of it."""
    import torch

    from kgs.geometry.cameras import to
    from kgs.stages import project

    views = fit.scene.train
    blind = []
    with torch.no_grad():
        gaussians = fit.model()
    for i, name in enumerate(views.names):
        camera = to(views.camera(i), fit.device)
        if not len(project(gaussians, camera, options=fit.options, colors=False, backend=fit.backend)):
            blind.append(name)
    if len(blind) == len(views):
        expected = f"some that a camera of {fit.scene.root} sees"
        advice = "are they in the frame of these cameras?"
        raise DataError(ply, "Gaussians", expected, f"none of {len(fit.model)}", advice=advice)
    if blind:
        say(f"these cameras see no Gaussian of {printable(ply)}: {listed(blind)}")
