"""PSNR of held-out views, separately where at least two training views show the scene and elsewhere.

A single training view does not determine depth, and what no view shows is guessed: a mean over all pixels says little.
"""

import math
from collections.abc import Iterable, Sequence
from statistics import fmean

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.datasets.scene import Scene
from kgs.geometry.cameras import project
from kgs.geometry.multiview import nearest_pixels, unproject

MIN_VIEWS = 2  # training views that show a point
OCCLUDED = 1.05  # a point is hidden from a view if it is farther than this times the view's depth there


@torch.no_grad()
def psnr_by_coverage(
    scene: Scene, train_depths: Sequence[Tensor], images: Iterable[Tensor], depths: Iterable[Tensor]
) -> dict[str, float | None] | None:
    """PSNR of the test views, separately for pixels that at least `MIN_VIEWS` training views show and for the rest.

    Convention:
        The median depth of the fit gives the point of a pixel. A training view shows it if it projects into that
        image and is no farther than `OCCLUDED` times the fit's median depth there. Pixels without depth count as
        not shown.

    Args:
        scene: training and test views.
        train_depths: median depths of the training views, each `(H, W)` on the CPU, 0 where there is nothing.
        images: renders of the test views, each `(1, 3, H, W)`, as :meth:`kgs.datasets.scene.Views.render` returns them.
        depths: median depths of the test views.

    Returns:
        "share" of the pixels that are shown, in [0, 1], "psnr" of them and "psnr_rest" in dB, means over the views
        that have such pixels; None if no view has, or if the error is 0. None without test views.
    """
    test = scene.test
    if not len(test):
        return None
    levels = {"psnr": list[float](), "psnr_rest": list[float]()}
    shares = list[float]()
    for view, (render, depth) in enumerate(zip(images, depths, strict=True)):
        covered = views_that_show(depth, test.camera(view), train_depths, scene.train.cameras) >= MIN_VIEWS
        image, photo, _ = test.compared(view, render[0].cpu())
        errors = (image - photo).square().mean(dim=0)
        valid = torch.ones_like(covered) if test.valid_mask is None else test.valid_mask[view].cpu()
        shares.append(float(covered[valid].float().mean()) if valid.any() else 0.0)
        for name, where in (("psnr", covered & valid), ("psnr_rest", ~covered & valid)):
            error = float(errors[where].mean()) if where.any() else 0.0
            if error > 0:
                levels[name].append(-10 * math.log10(error))
    means = {name: round(fmean(values), 4) if values else None for name, values in levels.items()}
    return {"share": round(fmean(shares), 4), **means}


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
    points = unproject(camera, pixels, own_depths, torch.zeros(len(pixels), dtype=torch.int64))
    other_pixels, other_depths = project(cameras, points)
    count = torch.zeros(len(pixels), dtype=torch.int64)
    for view, surface in enumerate(depths):
        point_depths = other_depths[:, view]
        x, y, inside = nearest_pixels(other_pixels[:, view], point_depths, *surface.mT.shape)
        count += (own_depths > 0) & inside & (point_depths <= OCCLUDED * surface[y, x])
    return count.reshape(height, width)
