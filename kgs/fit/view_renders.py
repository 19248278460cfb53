"""The renders of a fit's views, each made once."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.metrics.evaluate import clipped_psnr, view_psnr


class ViewRender(NamedTuple):
    """What a fit shows of a view."""

    image: Tensor  # (1, 3, H, W), in the exposure of the photo, as `Views.render` returns it
    median_depth: Tensor  # (H, W) on the CPU, 0 where there is nothing


class ViewRenders:
    """The renders of some views, each made when it is first asked for, and kept.

    Args:
        views: the views.
        render: from a camera and gains `(3,)` or None to image and median depth, as
            :meth:`kgs.fit.fit.Fit.render_with_depth`.
    """

    def __init__(self, views: Views, render: Callable[[PinholeCamera, Tensor | None], tuple[Tensor, Tensor]]) -> None:
        self._views = views
        self._render = render
        self._kept = dict[int, ViewRender]()

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> ViewRender:
        if index not in self._kept:
            gains = None if self._views.gains is None else self._views.gains[index]
            self._kept[index] = ViewRender(*self._render(self._views.camera(index), gains))
        return self._kept[index]

    @property
    def images(self) -> Iterator[Tensor]:
        """The images, each `(1, 3, H, W)`."""
        return (self[i].image for i in range(len(self)))

    @property
    def median_depths(self) -> Sequence[Tensor]:
        """The median depths, each `(H, W)` on the CPU."""
        return [self[i].median_depth for i in range(len(self))]

    @property
    def psnr_per_view(self) -> Iterator[float]:
        """The PSNR of each view in dB, rounded to 4 digits, with `kgs.metrics.evaluate.BEST` for infinity."""
        return (clipped_psnr(round(view_psnr(image, self._views, i), 4)) for i, image in enumerate(self.images))
