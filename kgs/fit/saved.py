"""Reads a fit from its folder: its settings, and its Gaussians for rendering and evaluation."""

from pathlib import Path
from typing import Any, NamedTuple

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.camera import move_camera
from kgs.datasets.scene import Scene
from kgs.errors import DataError
from kgs.io.results_folder import CHECKPOINT, complete_stopped_move
from kgs.json_files import is_number, read_json
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer

from .checkpoint import check_plain, newest_checkpoint
from .config import FitConfig
from .poses import place_cameras


def read_settings(path: Path) -> tuple[dict[str, Any], FitConfig]:
    """The arguments of `load_scene` and the configuration in a fit's config.json; a DataError where it is wrong."""
    settings = read_json(path)
    for name in ("request", "fit"):
        if not isinstance(settings.get(name), dict):
            raise DataError(path, name, f"expected an object, got {str(settings.get(name, 'none'))[:60]!r}")
    request = {"points": "none", "hold_out": None, **settings["request"]}  # defaults, for folders without these entries
    for name, expected, is_right in (
        ("scene", "a path", lambda v: isinstance(v, str) and v and "\0" not in v),
        ("train_views", "a whole number above 0 or null", lambda v: v is None or is_number(v, 1, whole=True)),
        ("downscale", "a number of at least 1 or null", lambda v: v is None or is_number(v, 1)),
        (
            "hold_out",
            "0, a whole number above 1 or null",
            lambda v: v is None or (is_number(v, 0, whole=True) and v != 1),
        ),
        ("background", "one of ['black', 'white']", lambda v: v in ("black", "white")),
        ("points", "one of ['none', 'model-points']", lambda v: v in ("none", "model-points")),
    ):
        if name not in request or not is_right(request[name]):
            got = f"{request[name]!r}"[:60] if name in request else "none"
            raise DataError(path, f"request.{name}", f"expected {expected}, got {got}")
    try:
        return request, FitConfig.from_dict(settings["fit"])
    except ValueError as error:
        raise DataError(path, "fit", str(error)) from error


class SavedFit(NamedTuple):
    """A fit for rendering and evaluation, without the state of its training."""

    request: dict[str, Any]  # the arguments of `load_scene`
    config: FitConfig
    model: GaussianModel  # in the frame of the scene: world coordinates less `Scene.offset`
    near_plane: float  # in world units
    step: int  # the number of steps that are done
    backend: str  # that of the fit; on a GPU "auto"
    poses: Tensor | None  # `(V, 4, 4)` of the training cameras, if the fit refined them

    def placed(self, scene: Scene) -> Scene:
        """The fit's scene, with the training cameras at the poses of the fit; a DataError if it has another number."""
        if self.poses is None:
            return scene
        if len(self.poses) != len(scene.train):
            reason = f"has {len(scene.train)} training views, but the fit has poses of {len(self.poses)}: fit again"
            raise DataError(scene.root, "train", reason)
        return place_cameras(scene, self.poses)

    @torch.no_grad()
    def render(self, camera: PinholeCamera, background: Tensor) -> Tensor:
        """Render all Gaussians from one camera over a background `(3,)`: `(1, 3, H, W)`, on the model's device."""
        device, most = self.model.means.device, self.config.max_bytes
        renderer = GaussianRenderer(near_plane=self.near_plane, max_bytes=most, backend=self.backend).eval()
        image: Tensor = renderer(self.model(), move_camera(camera, device), background.to(device)).image
        return image


def load_fit(out: Path, device: torch.device | str = "cpu") -> SavedFit:
    """Read a fit from its folder; a DataError if config.json or the checkpoint is missing or damaged."""
    complete_stopped_move(out)
    request, config = read_settings(out / "config.json")
    path = out / CHECKPOINT
    state, _ = newest_checkpoint(path)
    try:
        check_plain(state, "backend", "near_plane", "step")
    except KeyError as error:
        raise DataError(path, str(error.args[0]), "expected this entry in a checkpoint, got none") from error
    except ValueError as error:
        field, _, reason = str(error).partition(": ")
        raise DataError(path, field, reason) from error
    try:
        model = GaussianModel(**state["model"])
        model = (model.select(**part) if (part := state.get("shown")) else model).to(device)
        backend = state["backend"] if model.means.device.type == "cpu" else "auto"
        poses = (state.get("poses") or {}).get("extrinsics")
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DataError(path, "model", f"expected the Gaussians of a fit, got {error}") from error
    if poses is not None and not (isinstance(poses, Tensor) and poses.shape[1:] == (4, 4)):
        raise DataError(path, "poses", "expected extrinsics (V, 4, 4), got others")
    return SavedFit(request, config, model, float(state["near_plane"]), state["step"], backend, poses)
