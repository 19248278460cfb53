"""A fit as its folder has it: how its scene was loaded, what it was asked to do, and the Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.camera import move_camera
from kgs.errors import DataError
from kgs.json_files import read_json
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer

from .checkpoint import is_number, newest_checkpoint
from .config import FitConfig
from .folder import CHECKPOINT, recover

__all__ = ["SavedFit", "load_fit", "read_settings"]

_CHOICES: dict[str, tuple[Any, ...]] = {"background": ("black", "white"), "points": ("none", "model-points")}


def read_settings(path: Path) -> tuple[dict[str, Any], FitConfig]:
    """Read the config.json that `kgs fit` wrote.

    Returns:
        The arguments of `load_scene` (scene, train_views, downscale, background, points), and the configuration.

    Raises:
        DataError: the file is missing or damaged, or an entry is missing or wrong.
    """
    settings = read_json(path)
    for name in ("request", "fit"):
        if not isinstance(settings.get(name), dict):
            raise DataError(path, name, f"expected an object, got {str(settings.get(name, 'none'))[:60]!r}")
    request = {"points": "none", **settings["request"]}
    for name, what, is_right in (
        ("scene", "a path", lambda value: isinstance(value, str) and value and "\0" not in value),
        ("train_views", "a whole number above 0 or null", lambda v: v is None or (type(v) is int and v > 0)),
        ("downscale", "a number of at least 1 or null", lambda v: v is None or is_number(v, 1)),
        *((name, f"one of {list(known)}", known.__contains__) for name, known in _CHOICES.items()),
    ):
        if name not in request or not is_right(request[name]):
            got = f"{request[name]!r}"[:60] if name in request else "none"
            raise DataError(path, f"request.{name}", f"expected {what}, got {got}")
    try:
        return request, FitConfig.from_dict(settings["fit"])
    except ValueError as error:
        raise DataError(path, "fit", str(error)) from error


@dataclass(frozen=True)
class SavedFit:
    """A fit for pictures and measures, without what training needs.

    Args:
        request: the arguments of `load_scene`, see :func:`read_settings`.
        config: what the fit was asked to do.
        model: the Gaussians, in the frame of the scene (world coordinates less `Scene.offset`).
        near_plane: that of the fit's renders, in world units.
        step: how many steps are done.
    """

    request: dict[str, Any]
    config: FitConfig
    model: GaussianModel
    near_plane: float
    step: int

    @torch.no_grad()
    def render(self, camera: PinholeCamera, background: Tensor) -> Tensor:
        """All Gaussians from one camera over the scene's background `(3,)`, `(1, 3, H, W)`; on the model's device."""
        renderer = GaussianRenderer(near_plane=self.near_plane, max_bytes=self.config.max_bytes).eval()
        device = self.model.means.device
        image: Tensor = renderer(self.model(), move_camera(camera, device), background.to(device)).image
        return image


def load_fit(out: Path, device: torch.device | str = "cpu") -> SavedFit:
    """Read what a fit left in its folder, without optimiser, densifier and the scene.

    Raises:
        DataError: config.json or the checkpoint is missing or damaged.
    """
    recover(out)
    request, config = read_settings(out / "config.json")
    path = out / CHECKPOINT
    state, _ = newest_checkpoint(path)
    try:
        model = GaussianModel(**state["model"]).to(device)
        return SavedFit(request, config, model, float(state["near_plane"]), int(state["step"]))
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(path, "model", f"expected the Gaussians of a fit, got {error}") from error
