"""PSNR of held-out views, separately where at least two training views show the scene and elsewhere.

A single training view does not determine depth, and what no view shows is guessed: a mean over all pixels says little.
"""

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from statistics import fmean

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.datasets.scene import Scene
from kgs.geometry import nearest_pixels, project_points, unproject

MIN_VIEWS = 2  # training views that show a point
OCCLUDED = 1.05  # a point is hidden from a view if it is farther than this times the view's depth there


class Coverage:
    """PSNR of the test views, separately for pixels that at least `MIN_VIEWS` training views show and for the rest.

    Convention:
        The median depth of the fit gives the point of a pixel. A training view shows it if it projects into that
        image and is no farther than `OCCLUDED` times the fit's median depth there. Pixels without depth count as
        not shown.

    Args:
        scene: training and test views.
        median_depth: from a camera to its median depth `(H, W)` on the CPU, 0 where there is nothing.
    """

    def __init__(self, scene: Scene, median_depth: Callable[[PinholeCamera], Tensor]) -> None:
        self._scene = scene
        self._median_depth = median_depth
        self._levels: dict[str, list[float]] = {"psnr": [], "psnr_rest": []}
        self._shares = list[float]()

    @cached_property
    def _depths(self) -> list[Tensor]:
        """Of the training views."""
        train = self._scene.train
        return [self._median_depth(train.camera(view)) for view in range(len(train))]

    @torch.no_grad()
    def add(self, view: int, image: Tensor) -> None:
        """Take in a test view: its number and its render `(1, 3, H, W)`, as :meth:`Views.render` returns it."""
        test = self._scene.test
        camera = test.camera(view)
        depth = self._median_depth(camera)
        covered = views_that_show(depth, camera, self._depths, self._scene.train.cameras) >= MIN_VIEWS
        image, photo, _ = test.compared(view, image[0].cpu())
        errors = (image - photo).square().mean(dim=0)
        valid = torch.ones_like(covered) if test.valid_mask is None else test.valid_mask[view].cpu()
        self._shares.append(float(covered[valid].float().mean()) if valid.any() else 0.0)
        for name, where in (("psnr", covered & valid), ("psnr_rest", ~covered & valid)):
            error = float(errors[where].mean()) if where.any() else 0.0
            if error > 0:
                self._levels[name].append(-10 * math.log10(error))

    def means(self) -> dict[str, float | None] | None:
        """The means over the views that were added; None if none was.

        Returns:
            "share" of the pixels that are shown, in [0, 1], "psnr" of them and "psnr_rest" in dB, means over the views
            that have such pixels; None if no view has, or if the error is 0.
        """
        if not self._shares:
            return None
        levels = {name: round(fmean(values), 4) if values else None for name, values in self._levels.items()}
        return {"share": round(fmean(self._shares), 4), **levels}


def views_that_show(depth: Tensor, camera: PinholeCamera, depths: Sequence[Tensor], cameras: PinholeCamera) -> Tensor:
    """How many other cameras show the surface of each pixel of one camera, int64 `(H, W)`.

    A camera shows it if it projects into that image and is no farther than `OCCLUDED` times the depth of the nearest
    pixel there.

    Args:
        depth: of the one camera, `(H, W)`, 0 where there is nothing: no camera shows that.
        camera: the one camera.
        depths: of the others, each `(H, W)`.
        cameras: the others.
    """
    height, width = depth.shape
    pixels = torch.ones_like(depth).nonzero().flip(1)  # (x, y), row by row
    own_depths = depth.reshape(-1).double()
    points = unproject(pixels, own_depths, torch.zeros(len(pixels), dtype=torch.int64), camera)
    other_pixels, other_depths = project_points(points, cameras)
    count = torch.zeros(len(pixels), dtype=torch.int64)
    for view, surface in enumerate(depths):
        point_depths = other_depths[:, view]
        x, y, inside = nearest_pixels(other_pixels[:, view], point_depths, *surface.mT.shape)
        count += (own_depths > 0) & inside & (point_depths <= OCCLUDED * surface[y, x])
    return count.reshape(height, width)
