"""The config.json of a fit: how its scene was loaded and what it was asked to do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kgs.errors import DataError
from kgs.json_files import read_json

from .config import FitConfig

__all__ = ["read_settings"]

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
        ("downscale", "a number of at least 1 or null", _is_downscale),
        *((name, f"one of {list(known)}", known.__contains__) for name, known in _CHOICES.items()),
    ):
        if name not in request or not is_right(request[name]):
            got = f"{request[name]!r}"[:60] if name in request else "none"
            raise DataError(path, f"request.{name}", f"expected {what}, got {got}")
    try:
        return request, FitConfig.from_dict(settings["fit"])
    except ValueError as error:
        raise DataError(path, "fit", str(error)) from error


def _is_downscale(value: Any) -> bool:
    if value is None:
        return True
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 1 <= value < 1e300
