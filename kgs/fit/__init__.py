"""Turns a scene into a splat, with one call or in a loop of your own.

`initial_points` needs only the required packages; the others need the extra `app`.

Examples:
    >>> from kgs.fit import FitConfig, Trainer, initial_points, make_plan
    >>> from kgs.datasets import synthetic_scene
    >>> scene = synthetic_scene(train_views=2, size=(16, 16))
    >>> plan = make_plan(scene, FitConfig(steps=2))
    >>> trainer = Trainer(scene, plan, initial_points(scene.train, "random", count=50))
    >>> while trainer.step < plan.schedule.steps:
    ...     loss = trainer.train_step()
    >>> fit = trainer.result()
"""

from typing import TYPE_CHECKING

from kgs._support.lazy import lazy_names

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

# the other names import torch, OpenCV and safetensors
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "kgs.init_points": ("InitialPoints", "initial_points"),
        "kgs.fit.plan": ("Plan", "make_plan"),
        "kgs.fit.trainer": ("Trainer",),
        "kgs.fit.fit": ("Fit",),
        "kgs.fit.run": ("choose_points", "fit_scene"),
        "kgs.fit.measures": ("measure",),
    },
)
