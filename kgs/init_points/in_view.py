"""Checks that initial points lie where the training views look: a fit from other points shows nothing."""

import warnings
from os import PathLike

from torch import Tensor

from kgs.datasets.scene import Views
from kgs.errors import DataError, listed
from kgs.geometry import points_in_images


def check_in_view(points: Tensor, views: Views, path: str | PathLike[str]) -> None:
    """Refuse points of which no training image shows one; warn of single images that show none.

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
        counts = f"got none of {len(points)}, of which {in_front} lie before a camera"
        advice = "are they in the frame of the scene's cameras?"
        raise DataError(path, "initial points", f"expected some in a training image, {counts}: {advice}")
    blind = [name for name, shown in zip(views.names, inside.any(dim=0).tolist(), strict=True) if not shown]
    if blind:
        warnings.warn(f"initial points: none lies in the image of {listed(blind)}", stacklevel=3)
