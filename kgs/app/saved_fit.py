"""Reads a fit from its folder: its settings, its scene, and its Gaussians."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kgs._support.errors import DataError
from kgs._support.json_files import read_json
from kgs.app.files.publishing import complete
from kgs.app.files.results_folder import CHECKPOINT
from kgs.backends import former_or_auto
from kgs.datasets.scene import Scene
from kgs.fit.checkpoint import newest_checkpoint
from kgs.fit.config import FitConfig
from kgs.fit.decisions import Decisions
from kgs.fit.exposure import with_exposure
from kgs.fit.fit import Fit
from kgs.fit.poses import with_extrinsics
from kgs.fit.state import check_plain
from kgs.geometry.types import RasterOptions
from kgs.model import GaussianModel

from .scene_request import SceneRequest


def read_settings(path: Path) -> tuple[SceneRequest, FitConfig]:
    """The scene and the configuration in a fit's config.json; a DataError where it is wrong."""
    settings = read_json(path)
    for name in ("request", "fit"):
        if not isinstance(settings.get(name), dict):
            raise DataError(path, name, f"expected an object, got {str(settings.get(name, 'none'))[:60]!r}")
    request = SceneRequest.from_dict(settings["request"], path)
    try:
        return request, FitConfig.from_dict(settings["fit"])
    except ValueError as error:
        raise DataError(path, "fit", str(error)) from error


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
    request, settings = read_settings(out / "config.json")
    path = out / CHECKPOINT
    metrics = read_json(out / "metrics.json")
    values, damage = newest_checkpoint(path)
    model = _read_model(path, values).to(device)
    if backend == "auto":
        backend = former_or_auto(values["backend"], model.means.device)
    if values["step"] != metrics.get("steps"):
        whose = "that of the previous checkpoint, " if damage else ""
        reason = f"expected that of metrics.json, {metrics.get('steps')}, got {whose}{values['step']}: resume the fit"
        raise DataError(path, "step", reason)
    if damage and say is not None:
        say(f"{damage}; the previous checkpoint is used")
    scene = _posed(_exposed(request.load(out, say), path, values), path, values)
    options = RasterOptions(near_plane=float(values["near_plane"]), max_bytes=settings.max_bytes)
    return request, Fit(scene, model, options, backend, settings, metrics=metrics)


def _read_model(path: Path, values: dict[str, Any]) -> GaussianModel:
    """The Gaussians that a checkpoint shows."""
    try:
        check_plain(values, "backend", "near_plane", "step")
    except KeyError as error:
        raise DataError(path, str(error.args[0]), "expected this entry in a checkpoint, got none") from error
    except ValueError as error:
        field, _, reason = str(error).partition(": ")
        raise DataError(path, field, reason) from error
    try:
        model = GaussianModel(**values["model"])
        part = values.get("shown")
        return model.select(**part) if part else model
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DataError(path, "model", f"expected the Gaussians of a fit, got {error}") from error


def _exposed(scene: Scene, path: Path, values: dict[str, Any]) -> Scene:
    """The scene, with the gains of the training photos that were decided."""
    try:
        return with_exposure(scene, Decisions.from_dict(values.get("decisions", {})))
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(path, "decisions", f"expected the gains of {len(scene.train)} photos: {error}") from error


def _posed(scene: Scene, path: Path, values: dict[str, Any]) -> Scene:
    """The scene, with the training cameras where the fit left them."""
    poses = values.get("poses")
    if poses is None:
        return scene
    extrinsics = poses.get("extrinsics") if isinstance(poses, dict) else None
    if not (isinstance(extrinsics, Tensor) and extrinsics.shape[1:] == (4, 4)):
        given = tuple(extrinsics.shape) if isinstance(extrinsics, Tensor) else type(poses).__name__
        raise DataError(path, "poses", f"expected extrinsics (V, 4, 4), got {given}")
    if len(extrinsics) != len(scene.train):
        reason = f"has {len(scene.train)} training views, but the fit has poses of {len(extrinsics)}: fit again"
        raise DataError(scene.root, "train", reason)
    return with_extrinsics(scene, extrinsics)
