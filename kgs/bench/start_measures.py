"""Measures of first points: errors of their depths, and which pixels have one, against exact depths or other points."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import torch
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.fit.starts.triangulate import camera_centers, project_all, unproject

__all__ = ["CLOSE", "NEAR", "complete_pixels", "depth_errors", "front_depths", "model_errors", "seen_twice"]

NEAR, CLOSE = 0.01, 0.02  # relative depth errors that are counted
HIDDEN = 0.05  # a point so much farther than the surface before it is hidden there, not wrong
REACH, MODEL_REACH = 2.0, 1.5  # pixels, from a point to the pixel it stands for, and to a point of COLMAP's
EDGE = 1.05  # ratio of depths of neighbouring pixels above which nothing is interpolated between them


def depth_errors(points: Tensor, views: Views, truth: Tensor) -> Tensor:
    """The relative error of each point's depth, in the nearest view that it is not hidden in.

    The depth of the surface is interpolated between pixels, as the inverse depth, which is linear on a plane; at an
    edge (neighbours more than 5 % apart) it is that of the pixel the point falls into. A point more than 5 % behind
    the surface counts as hidden in that view; one that is hidden in all views is judged in the nearest of them.

    Convention:
        Depth is z in the camera's frame (OpenCV axes); pixels have integer centres.

    Args:
        points: `(P, 3)` in the frame of the views.
        views: V of them; the nearest is that whose camera is nearest to the point, of those it projects into.
        truth: exact depths, `(V, H, W)` float64; 0 where there is no surface.

    Returns:
        Depth over the surface's depth less 1, `(P,)` float64: negative before the surface, -1 before none; infinite
        where no view has the point in its image.
    """
    errors = torch.stack([_view_errors(points, views, truth, view) for view in range(len(views))], 1)
    inside = ~errors.isnan()
    seen = inside & (errors <= HIDDEN)
    usable = torch.where(seen.any(1, keepdim=True), seen, inside)
    distances = torch.cdist(points.double(), camera_centers(views.cameras)).masked_fill(~usable, torch.inf)
    nearest = errors.gather(1, distances.argmin(1, keepdim=True))[:, 0]
    return torch.where(inside.any(1), nearest, torch.inf)


def complete_pixels(points: Tensor, views: Views, truth: Tensor) -> Tensor:
    """Which pixels have a point within 2 pixels whose depth is within 2 % of the pixel's exact depth, `(V, H, W)`.

    Args:
        points: `(P, 3)` in the frame of the views.
        views: V of them.
        truth: exact depths, `(V, H, W)` float64; 0 where there is no surface, which is never complete.
    """
    found = torch.zeros_like(truth, dtype=torch.bool)
    for view, exact in enumerate(truth):
        pixels, depths = _in_image(points, views, view)
        for inside, x, y, _ in _around(pixels, truth.shape[-2:], REACH):
            close = (depths[inside] / exact[y, x] - 1).abs() <= CLOSE
            found[view, y[close], x[close]] = True
    return found


def seen_twice(views: Views, truth: Tensor) -> Tensor:
    """Which pixels show a surface that another view shows too, to 1 % of its depth there, `(V, H, W)`."""
    found = torch.zeros_like(truth, dtype=torch.bool)
    for view, exact in enumerate(truth):
        rows, columns = (exact > 0).nonzero().unbind(1)
        pixels = torch.stack([columns, rows], 1)
        points = unproject(pixels, exact[rows, columns], torch.full_like(rows, view), views.cameras)
        for other in range(len(views)):
            if other != view:
                found[view, rows, columns] |= _view_errors(points, views, truth, other).abs() <= NEAR
    return found


def model_errors(points: Tensor, model: Tensor, views: Views) -> Tensor:
    """Relative errors of the points' depths where a view has them within 1.5 pixels of a point of a COLMAP model.

    A pixel's depth is that of the first of the points in it, and a model's point is compared with the nearest pixel
    that has any. All views that a model's point projects into count, also those where something hides it.

    Args:
        points: `(P, 3)` in the frame of the views.
        model: `(M, 3)`, taken as the truth.
        views: of the pictures.

    Returns:
        Depth over the model's depth less 1, one number a pair of a model's point and a view, float64.
    """
    errors = [torch.zeros(0, dtype=torch.float64)]
    for view in range(len(views)):
        front = front_depths(points, views, view)
        pixels, depths = _in_image(model, views, view)
        nearest, found = torch.full_like(depths, torch.inf), torch.full_like(depths, torch.inf)
        for inside, x, y, distances in _around(pixels, front.shape, MODEL_REACH):
            better = front[y, x].isfinite() & (distances < nearest[inside])
            found[inside[better]] = front[y, x][better]
            nearest[inside[better]] = distances[better]
        errors.append((found / depths - 1)[found.isfinite()])
    return torch.cat(errors)


def front_depths(points: Tensor, views: Views, view: int) -> Tensor:
    """The least depth of the points in each pixel of one view, `(H, W)`; infinite where there is none."""
    height, width = views.images.shape[-2:]
    pixels, depths = _in_image(points, views, view)
    x, y = pixels.round().long().unbind(1)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    empty = torch.full((height * width,), torch.inf, dtype=torch.float64)
    return empty.scatter_reduce(0, (y * width + x)[inside], depths[inside], "amin").reshape(height, width)


def _view_errors(points: Tensor, views: Views, truth: Tensor, view: int) -> Tensor:
    """Depth over the surface's depth less 1 in one view, `(P,)`; NaN where the point is not in its image."""
    pixels, depths = (part[:, 0] for part in project_all(points, views.camera(view)))
    inverse = torch.where(truth[view] > 0, 1 / truth[view], 0.0)
    height, width = inverse.shape
    limits = torch.tensor([width, height]) - 0.5
    inside = (depths > 0) & ((pixels > -0.5) & (pixels < limits)).all(1)
    x, y = torch.where(inside[:, None], pixels, 0.0).clamp(torch.zeros(2), limits - 0.5).unbind(1)
    left, top = x.floor().long().clamp(max=width - 2), y.floor().long().clamp(max=height - 2)
    right, below = x - left, y - top
    corners = torch.stack([inverse[top + i, left + j] for i in (0, 1) for j in (0, 1)])
    weights = torch.stack([a * b for a in (1 - below, below) for b in (1 - right, right)])
    own = corners.gather(0, weights.argmax(0, keepdim=True))[0]
    smooth = corners.amax(0) <= EDGE * corners.amin(0)
    return torch.where(inside, depths * torch.where(smooth, (weights * corners).sum(0), own) - 1, torch.nan)


def _in_image(points: Tensor, views: Views, view: int) -> tuple[Tensor, Tensor]:
    """Pixels `(Q, 2)` and depths `(Q,)` of the points that are in the image of one view, or at most 2 pixels out."""
    pixels, depths = (part[:, 0] for part in project_all(points, views.camera(view)))
    height, width = views.images.shape[-2:]
    limits = torch.tensor([width - 1, height - 1])
    inside = (depths > 0) & ((pixels >= -REACH) & (pixels <= limits + REACH)).all(1)
    return pixels[inside], depths[inside]


def _around(pixels: Tensor, size: torch.Size, reach: float) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """For each place of a disc: which of the pixels `(Q, 2)` it is in the image for, its x and y, and how far it is."""
    for offset in product((-2, -1, 0, 1, 2), repeat=2):
        places = pixels.round() + torch.tensor(offset)
        distances = (places - pixels).norm(dim=1)
        inside = ((places >= 0) & (places < torch.tensor([size[1], size[0]]))).all(1) & (distances <= reach)
        x, y = places[inside].long().unbind(1)
        yield inside.nonzero()[:, 0], x, y, distances[inside]
