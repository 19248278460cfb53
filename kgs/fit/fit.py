"""A fit that is done, or as far as it is: a splat with what is needed to render, measure and show it."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.backends import Backend, get_backend
from kgs.datasets.scene import Scene, Views
from kgs.geometry.cameras import to
from kgs.geometry.types import RasterOptions
from kgs.metrics.evaluate import mean_psnr
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer
from kgs.stages import blend

from .config import Settings
from .decisions import Decisions
from .targets import background_of
from .view_renders import ViewRenders


@dataclass(frozen=True, eq=False)
class Fit:
    """A splat of a scene, and how it came about.

    Args:
        scene: with the training cameras where the fit left them.
        model: the Gaussians, in the frame of the scene.
        options: of the renderer.
        backend: of the renderer.
        settings: of the fit; None for a splat that is not one of kgs.
        history: plain values for metrics.json: "steps", "seconds", "curve", "init", "poses".
        decisions: what was decided about it, and why.
        metrics: the content of metrics.json, once it is measured.
        notes: lines that a user should read.
        part: which of the trained Gaussians `model` has, after pruning: "rows", bool, and "sh_degree".
    """

    scene: Scene
    model: GaussianModel
    options: RasterOptions
    backend: str = "auto"
    settings: Settings | None = None
    history: dict[str, Any] = field(default_factory=dict)
    decisions: Decisions = field(default_factory=Decisions)
    metrics: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    part: dict[str, Any] = field(default_factory=dict)

    @property
    def device(self) -> torch.device:
        """The device of the Gaussians."""
        return self.model.means.device

    @cached_property
    def _table(self) -> Backend:
        return get_backend(self.backend, self.device)

    @cached_property
    def _renderer(self) -> GaussianRenderer:
        return GaussianRenderer(options=self.options, backend=self._table).eval()

    @cached_property
    def _background(self) -> Tensor | None:
        return background_of(self.scene, self.device)

    @cached_property
    def train_renders(self) -> ViewRenders:
        """The renders of the training views, each made once: they stay what they are if the model trains on."""
        return ViewRenders(self.scene.train, self.render_with_depth)

    @cached_property
    def test_renders(self) -> ViewRenders:
        """The renders of the test views, as :attr:`train_renders`."""
        return ViewRenders(self.scene.test, self.render_with_depth)

    def annotated(self, **changes: Any) -> Self:
        """The fit with other `decisions`, `metrics` or `notes`: it renders the same, and keeps what it has rendered."""
        annotated = replace(self, **changes)
        vars(annotated).update(train_renders=self.train_renders, test_renders=self.test_renders)
        return annotated

    @torch.no_grad()
    def render(self, camera: PinholeCamera, gains: Tensor | None = None) -> Tensor:
        """Render all Gaussians from one camera before the background of the scene, `(1, 3, H, W)`.

        Args:
            camera: on any device.
            gains: the exposure of a photo, `(3,)`: factors of the Gaussians' colours, not of the background; None: 1.
        """
        image, _ = self._render(camera, gains)
        return image

    @torch.no_grad()
    def render_with_depth(self, camera: PinholeCamera, gains: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """What :meth:`render` returns, and the median depth of the Gaussians, `(H, W)` on the CPU, 0 in the empty."""
        image, rendering = self._render(camera, gains, "median_depth")
        return image, rendering.median_depth[0, 0].cpu()

    def _render(self, camera: PinholeCamera, gains: Tensor | None, *outputs: str) -> tuple[Tensor, Any]:
        camera = to(camera, self.device)
        background = self._background if gains is None else None
        outputs = ("image", *outputs) if gains is None else ("image", "alpha", *outputs)
        with self._table.beside():
            rendering: Any = self._renderer(self.model(backend=self._table), camera, background, outputs=outputs)
        if gains is None:
            return rendering.image, rendering
        exposed = rendering.image * gains.to(rendering.image)[:, None, None]
        return blend(exposed, 1.0 - rendering.alpha, self._background, self._table), rendering

    def psnr(self, views: Views) -> float | None:
        """The mean PSNR of clamped renders over some views, in dB. Without views, or if one is infinite: None."""
        return mean_psnr(self.render, views)
