"""A fit in another unit of length, in which a splat has the size of the thing that it shows."""

import math
from dataclasses import replace

from kgs._support.errors import ArgumentError
from kgs.datasets.scene import Scene, Views
from kgs.geometry.cameras import posed
from kgs.model import GaussianModel

from .fit import Fit


def scaled_model(model: GaussianModel, factor: float) -> GaussianModel:
    """A new model whose Gaussians have their centres and standard deviations multiplied.

    Args:
        model: the Gaussians; they stay as they are.
        factor: above 0.

    Raises:
        ValueError: `factor` is not a finite number above 0.
    """
    _check(factor)
    values = {name: parameter.detach() for name, parameter in model.per_gaussian().items()}
    values["means"] = values["means"] * factor
    values["log_scales"] = values["log_scales"] + math.log(factor)
    return GaussianModel(**values, sh_degree=model.sh_degree, antialiased=model.antialiased)


def scaled(fit: Fit, factor: float) -> Fit:
    """The fit in a world whose lengths are multiplied: the same pictures, and depths that are `factor` times as large.

    Convention:
        World-to-camera extrinsics: their translations are multiplied, the rest stays. The world is scaled
        about the origin of the scene's files, so `Scene.offset` is multiplied, too.

    Args:
        fit: stays as it is.
        factor: lengths in the new world, of one in the old world; above 0.

    Raises:
        ValueError: `factor` is not a finite number above 0.
    """
    _check(factor)
    near_plane = factor * fit.options.near_plane
    far_plane = factor * fit.options.far_plane
    options = replace(fit.options, near_plane=near_plane, far_plane=far_plane)
    return replace(fit, scene=_scaled_scene(fit.scene, factor), model=scaled_model(fit.model, factor), options=options)


def _check(factor: float) -> None:
    if not (math.isfinite(factor) and factor > 0):
        raise ArgumentError("factor", "a finite number above 0", factor)


def _scaled_scene(scene: Scene, factor: float) -> Scene:
    return replace(
        scene,
        train=_scaled_views(scene.train, factor),
        test=_scaled_views(scene.test, factor),
        train_full_size=None if scene.train_full_size is None else _scaled_views(scene.train_full_size, factor),
        points=scene.points * factor,
        offset=scene.offset * factor,
    )


def _scaled_views(views: Views, factor: float) -> Views:
    extrinsics = views.cameras.extrinsics.clone()
    extrinsics[:, :3, 3] *= factor
    return replace(views, cameras=posed(views.cameras, extrinsics))
