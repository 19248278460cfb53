"""Finds the veils of a fit: Gaussians before the surface where a render is hazier than its photo.

Where the darkest colour around a pixel (the dark channel: K. He, J. Sun and X. Tang, "Single Image Haze Removal Using
Dark Channel Prior", CVPR 2009) is brighter in the render than in the photo, something transparent floats before the
surface. DOC-GS (2026) removes Gaussians by this sign. Here all that lie before the surface there fade, whatever their
colours, and those that the photos need recover.
"""

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from kgs.datasets.splits import select_evenly
from kgs.geometry.cameras import project
from kgs.geometry.multiview import nearest_pixels

from .fit import Fit

WINDOW = 7  # pixels, the side of the square whose darkest colour counts
HAZE = 0.02  # by which the darkest colour of the render exceeds that of the photo
FRONT = 0.9  # of the median depth: what is nearer floats before the surface
FADE = 0.5  # factor of their opacities
MAX_VIEWS = 12  # that are looked at


@torch.no_grad()
def veils(fit: Fit) -> Tensor:
    """Which Gaussians lie before the surface at a hazy pixel of a training view, bool `(N,)`.

    None before a bright background: where the fit is transparent, that would count as haze.
    """
    views = fit.scene.train
    means = fit.model.means.detach().cpu()
    found = torch.zeros(len(means), dtype=torch.bool)
    if fit.scene.background.any():
        return found
    for view in select_evenly(len(views), min(len(views), MAX_VIEWS)):
        camera = views.camera(view)
        gains = None if views.gains is None else views.gains[view]
        image, surface = fit.render_with_depth(camera, gains)
        shown, photo, _ = views.compared(view, image)
        is_hazy = (darkest(shown[0]) - darkest(photo) > HAZE).cpu()
        height, width = surface.shape
        pixels, depths = (values[:, 0] for values in project(camera, means))
        x, y, is_inside = nearest_pixels(pixels, depths, width, height)
        found |= is_inside & is_hazy[y, x] & (depths < FRONT * surface[y, x])
    return found


def darkest(image: Tensor) -> Tensor:
    """The dark channel of an image `(3, H, W)`: the least number within `WINDOW` pixels in any channel, `(H, W)`."""
    darkness: Tensor = max_pool2d(1 - image.amin(0)[None], WINDOW, stride=1, padding=WINDOW // 2)
    return 1 - darkness[0]
