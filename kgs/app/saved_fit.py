"""Reads a fit from its folder: its settings, its scene, and its Gaussians."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kgs._support.errors import DataError, quoted
from kgs._support.json_files import read_json
from kgs.app.files.fit_files import CHECKPOINT
from kgs.app.files.results import complete
from kgs.backends import get_backend
from kgs.datasets.scene import Scene
from kgs.fit.checkpoint import errors_of, newest_checkpoint
from kgs.fit.config import Settings
from kgs.fit.decisions import Decisions
from kgs.fit.exposure import with_exposure
from kgs.fit.fit import Fit
from kgs.fit.poses import with_extrinsics
from kgs.fit.state import check_plain, state_errors
from kgs.geometry.types import RasterOptions
from kgs.model import GaussianModel

from .scene_request import SceneRequest

_HISTORY = ("steps", "seconds", "curve", "init", "poses")  # of metrics.json


def read_request(path: Path) -> SceneRequest:
    """How the scene of a fit was loaded, of its config.json; a DataError where it is wrong."""
    values = read_json(path).get("request")
    if not isinstance(values, dict):
        raise DataError(path, "request", "an object", quoted(values))
    return SceneRequest.from_dict(values, path)


def load_fit(
    out: Path,
    device: torch.device | str = "cpu",
    backend: str = "auto",
    say: Callable[[str], None] | None = None,
) -> tuple[SceneRequest, Fit]:
    """Read a fit from its folder, and load its scene.

    Args:
        out: the folder of the results.
        device: for the Gaussians.
        backend: of the renderer; "auto": that of the fit where that is there and runs on the device, else the
            fastest.
        say: gets the notes of the loader.

    Raises:
        DataError: config.json, the checkpoint or the scene is missing, damaged, or does not fit the others.
    """
    complete(out)
    request = read_request(out / "config.json")
    path = out / CHECKPOINT
    metrics = read_json(out / "metrics.json")
    values, damage = newest_checkpoint(path)
    with errors_of(path), state_errors():
        check_plain(values, "backend", "decisions", "near_plane", "notes", "step")
        settings = Settings.from_dict(values["config"])
        model = GaussianModel(**values["model"])
        part = values.get("shown", {})
        model = (model.select(**part) if part else model).to(device)
    if backend == "auto":
        backend = get_backend(values["backend"], model.means.device, required=False).name
    if values["step"] != metrics.get("steps"):
        whose = "that of the previous checkpoint, " if damage else ""
        expected = f"that of metrics.json, {metrics.get('steps')}"
        raise DataError(path, "step", expected, f"{whose}{values['step']}", advice="resume the fit")
    if damage and say is not None:
        say(f"{damage}; the previous checkpoint is used")
    with errors_of(out / "metrics.json"), state_errors():
        history = {name: metrics[name] for name in _HISTORY}
        decisions = Decisions.from_dict(metrics["decisions"])
    without_depths = replace(request, depths="")  # which a fit needs before its first step
    scene = _posed(_exposed(without_depths.load(out, say), path, values), path, values)
    options = RasterOptions(near_plane=float(values["near_plane"]), max_bytes=settings.max_bytes)
    fit = Fit(scene, model, options, backend, settings, history, decisions, metrics, tuple(values["notes"]), part)
    return request, fit


def _exposed(scene: Scene, path: Path, values: dict[str, Any]) -> Scene:
    """The scene, with the gains of the training photos that were decided."""
    try:
        return with_exposure(scene, Decisions.from_dict(values["decisions"]))
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(path, "decisions", f"the gains of {len(scene.train)} photos", str(error)) from error


def _posed(scene: Scene, path: Path, values: dict[str, Any]) -> Scene:
    """The scene, with the training cameras where the fit left them."""
    poses = values.get("poses")
    if poses is None:
        return scene
    extrinsics = poses.get("extrinsics") if isinstance(poses, dict) else None
    if not (isinstance(extrinsics, Tensor) and extrinsics.shape[1:] == (4, 4)):
        given = tuple(extrinsics.shape) if isinstance(extrinsics, Tensor) else type(poses).__name__
        raise DataError(path, "poses", "extrinsics (V, 4, 4)", given)
    if len(extrinsics) != len(scene.train):
        expected = f"the {len(extrinsics)} training views of the fit"
        raise DataError(scene.root, "train", expected, len(scene.train), advice="fit again")
    return with_extrinsics(scene, extrinsics)
