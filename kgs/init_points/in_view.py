"""Checks that initial points lie where the training views look: a fit from other points renders nothing."""

from os import PathLike

from torch import Tensor

from kgs._support.errors import DataError, listed, warn
from kgs.datasets.scene import Views
from kgs.geometry.multiview import points_in_images


def check_in_view(points: Tensor, views: Views, path: str | PathLike[str]) -> None:
    """Raise an error if no point lies in a training image; warn about single images without any.

    Args:
        points: in the frame of the views, `(P, 3)`.
        views: the training views.
        path: the file or scene that the points come from, for the error.

    Raises:
        DataError: no point lies in a training image, in front of its camera.
    """
    depths, inside = points_in_images(points, views.cameras)
    if not bool(inside.any()):
        in_front = int((depths > 0).any(dim=1).sum())
        counts = f"none of {len(points)}, of which {in_front} lie before a camera"
        advice = "are they in the frame of the scene's cameras?"
        raise DataError(path, "initial points", "some in a training image", counts, advice=advice)
    has_points = inside.any(dim=0).tolist()
    empty = [name for name, has_some in zip(views.names, has_points, strict=True) if not has_some]
    if empty:
        warn(f"initial points: none lies in the image of {listed(empty)}")
