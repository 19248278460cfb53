"""Points where the error is: dense points that are left become Gaussians where renders differ most from the photos.

Source: ConeGS (arXiv 2511.06810, 2025): pixels are drawn with a probability proportional to their error, and each gets
a small Gaussian at its depth. There a network knows the depth, here it is that of the plane sweep. The error of a pixel
is that of the last step that rendered its view, so that no more renders are needed.
"""

from typing import Self

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import interpolate

from kgs._support.errors import ArgumentError
from kgs.datasets.scene import Views
from kgs.geometry.cameras import image_size, project, select
from kgs.geometry.multiview import nearest_pixels
from kgs.init_points.dense import Reserve
from kgs.model import GaussianModel

from .exposure import before_gain

SCALE = 0.25  # of a photo's pixel, the standard deviation of a new Gaussian: larger ones blur


class ErrorPoints:
    """P points of the training views' pixels that may become Gaussians, each once.

    Args:
        cameras: the training cameras.
        device: of the fit.
        points: in the frame of the cameras, `(P, 3)` float32.
        colors: RGB without the gains of the photos, `(P, 3)` uint8.
        views: the view that each point is from, `(P,)`.
        errors: the last error at each point's pixel, `(P,)` float32.
        is_left: the points that have not been drawn, bool `(P,)`.
        generator: the state of the random stream of draws.
    """

    def __init__(
        self,
        cameras: PinholeCamera,
        device: torch.device,
        *,
        points: Tensor,
        colors: Tensor,
        views: Tensor,
        errors: Tensor,
        is_left: Tensor,
        generator: Tensor,
    ) -> None:
        count = len(points)
        for name, values in (("colors", colors), ("views", views), ("errors", errors), ("is_left", is_left)):
            if len(values) != count:
                raise ArgumentError(f"error_points/{name}", f"{count} rows", len(values))
        self._size = image_size(cameras)
        self._points = points.to(device)
        self._colors = colors.to(device)
        self._views = views.to(device)
        self._errors = errors.to(device)
        self._is_left = is_left.to(device)
        self._generator = torch.Generator()
        self._generator.set_state(generator)
        scales = torch.zeros(count, dtype=torch.float32, device="cpu")
        self._rows = list[Tensor]()  # of each view's points
        self._pixels = list[Tensor]()  # of these, numbered row by row
        height, width = self._size
        for view in range(cameras.batch_size):
            camera = select(cameras, [view])
            rows = (views.cpu() == view).nonzero()[:, 0]
            pixels, depths = (values[:, 0] for values in project(camera, points.cpu()[rows]))
            x, y, _ = nearest_pixels(pixels, depths, width, height)
            focal = float((camera.fx * camera.fy).sqrt())
            scales[rows] = (SCALE / focal * depths).float()
            self._rows.append(rows.to(device))
            self._pixels.append((y * width + x).to(device))
        self._scales = scales.to(device)

    @classmethod
    def of(cls, reserve: Reserve, views: Views, seed: int, device: torch.device) -> Self:
        """All of the reserve, with no errors yet. `views` are those of the fit, of any size."""
        colors = before_gain(reserve.colors, views.gains, reserve.views)
        return cls(
            views.cameras,
            device,
            points=reserve.points,
            colors=(255.0 * colors).round().to(torch.uint8),
            views=reserve.views.int(),
            errors=reserve.points.new_zeros(len(reserve.points)),
            is_left=torch.ones_like(reserve.views, dtype=torch.bool),
            generator=torch.Generator().manual_seed(seed).get_state(),
        )

    def observe(self, view: int, render: Tensor, photo: Tensor) -> None:
        """Take the errors of a view from its render, as photographed, and its photo, both `(1, 3, H, W)`.

        They may be smaller than the views of the fit.
        """
        error = (render - photo).abs().mean(1, keepdim=True)
        if error.shape[-2:] != self._size:
            error = interpolate(error, self._size)
        self._errors[self._rows[view]] = error.flatten()[self._pixels[view]]

    def draw(self, count: int, sh_degree: int) -> GaussianModel:
        """At most `count` new Gaussians at points that are left, with a probability proportional to the error."""
        # on the CPU, whose random stream goes on on any device; NaN is not drawn: the trainer reports it
        weights = (self._errors * self._is_left).cpu().nan_to_num(0.0, posinf=0.0)
        count = max(0, min(count, int((weights > 0).sum())))
        rows = torch.multinomial(weights, count, generator=self._generator) if count else torch.empty(0).long()
        rows = rows.to(self._points.device)
        self._is_left[rows] = False
        return GaussianModel.from_points(
            self._points[rows], self._colors[rows].float() / 255.0, sh_degree, self._scales[rows]
        )

    def state_dict(self) -> dict[str, Tensor]:
        """The arguments of the class, without cameras and device, for a checkpoint."""
        return {
            "points": self._points,
            "colors": self._colors,
            "views": self._views,
            "errors": self._errors,
            "is_left": self._is_left,
            "generator": self._generator.get_state(),
        }
