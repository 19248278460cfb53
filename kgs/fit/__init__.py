"""Turns a scene into a splat, with one call or in a loop of your own.

`initial_points` needs only the required packages; `Trainer` and `fit_scene` need the extra `app`.

Examples:
    >>> from kgs.fit import FitConfig, Trainer, initial_points
    >>> from kgs.datasets import synthetic_scene
    >>> scene = synthetic_scene(train_views=2, size=(16, 16))
    >>> trainer = Trainer(scene, FitConfig(steps=2), initial_points(scene.train, "random", count=50))
    >>> while trainer.step < trainer.config.steps:
    ...     loss = trainer.train_step()
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .config import FitConfig

if TYPE_CHECKING:
    from kgs.init_points import InitialPoints, initial_points

    from .run import fit_scene
    from .trainer import Trainer

__all__ = ["InitialPoints", "FitConfig", "Trainer", "initial_points", "fit_scene"]

_MODULES = {
    "InitialPoints": "kgs.init_points",
    "Trainer": "kgs.fit.trainer",
    "initial_points": "kgs.init_points",
    "fit_scene": "kgs.fit.run",
}


def __getattr__(name: str) -> Any:
    """Load the other names on first use: they import OpenCV and trimesh."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
