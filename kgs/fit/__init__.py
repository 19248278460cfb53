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

from typing import TYPE_CHECKING

from kgs.lazy import lazy_names

from .config import FitConfig

if TYPE_CHECKING:
    from kgs.init_points import InitialPoints, initial_points

    from .run import fit_scene
    from .trainer import Trainer

__all__ = ["InitialPoints", "FitConfig", "Trainer", "initial_points", "fit_scene"]

# the other names import OpenCV and trimesh
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "kgs.init_points": ("InitialPoints", "initial_points"),
        "kgs.fit.run": ("fit_scene",),
        "kgs.fit.trainer": ("Trainer",),
    },
)
