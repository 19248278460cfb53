"""Turns a scene into a splat, with one call or in a loop of your own.

`initial_points` needs the extra `scenes`; the others need `app`.

Examples:
    >>> from kgs.fit import FitConfig, Trainer, choose_points, make_plan, prune
    >>> from kgs.datasets import synthetic_scene
    >>> scene = synthetic_scene(train_views=2, size=(16, 16))
    >>> config = FitConfig(steps=2, init="random", init_points=50)
    >>> points = choose_points(scene, config)
    >>> plan = make_plan(scene, config, points)
    >>> trainer = Trainer(scene, plan, points)
    >>> while trainer.step < plan.schedule.steps:
    ...     loss = trainer.train_step()
    >>> fit = prune(trainer.result())  # as `fit_scene(scene, config)`
"""

from typing import TYPE_CHECKING

from kgs._support.lazy import lazy_names

from .config import FitConfig

if TYPE_CHECKING:
    from kgs.init_points import InitialPoints, initial_points

    from .fit import Fit
    from .measures import measure
    from .plan import Plan, make_plan
    from .pruning import prune
    from .run import Hooks, choose_points, fit_scene
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
    "prune",
    "fit_scene",
    "Hooks",
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
        "kgs.fit.run": ("Hooks", "choose_points", "fit_scene"),
        "kgs.fit.pruning": ("prune",),
        "kgs.fit.measures": ("measure",),
    },
)
