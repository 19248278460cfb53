"""Turns a scene into a splat, with one call or in a loop of your own.

`initial_points` needs only the required packages; the others need the extra `app`.

Examples:
    >>> from kgs.fit import FitConfig, Trainer, initial_points, make_plan
    >>> from kgs.datasets import synthetic_scene
    >>> scene = synthetic_scene(train_views=2, size=(16, 16))
    >>> plan = make_plan(scene, FitConfig(steps=2))
    >>> trainer = Trainer(scene, plan, initial_points(scene.train, "random", count=50))
    >>> while trainer.step < plan.times.steps:
    ...     loss = trainer.train_step()
    >>> fit = trainer.result()
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .config import FitConfig

if TYPE_CHECKING:
    from kgs.init_points import InitialPoints, initial_points

    from .fit import Fit
    from .measures import measure
    from .plan import Plan, make_plan
    from .run import choose_points, fit_scene
    from .trainer import Trainer

__all__ = [
    "InitialPoints",
    "FitConfig",
    "Plan",
    "Trainer",
    "Fit",
    "initial_points",
    "choose_points",
    "make_plan",
    "fit_scene",
    "measure",
]

_MODULES = {
    "InitialPoints": "kgs.init_points",
    "initial_points": "kgs.init_points",
    "Plan": "kgs.fit.plan",
    "make_plan": "kgs.fit.plan",
    "Trainer": "kgs.fit.trainer",
    "Fit": "kgs.fit.fit",
    "choose_points": "kgs.fit.run",
    "fit_scene": "kgs.fit.run",
    "measure": "kgs.fit.measures",
}


def __getattr__(name: str) -> Any:
    """Load the other names on first use: they import OpenCV and trimesh."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
