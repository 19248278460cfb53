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

from kgs._support.lazy import public_names

# torch, OpenCV and safetensors are imported with the names that need them
__getattr__, __dir__, __all__ = public_names(__name__, __file__)
