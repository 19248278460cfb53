"""Finds the veils of a fit: Gaussians before the surface where a render is hazier than its photo.

Between two dark things in a photo there is hardly ever haze; where the darkest colour around a pixel (the dark channel:
K. He, J. Sun and X. Tang, "Single Image Haze Removal Using Dark Channel Prior", CVPR 2009) is brighter in the render
than in the photo, something bright and transparent floats before the surface. DOC-GS (2026) removes such Gaussians;
here they fade, and those that the photos need recover.
"""

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from kgs.geometry import nearest_pixels, project_points

from .fit import Fit

WINDOW = 7  # pixels, the side of the square whose darkest colour counts
HAZE = 0.02  # by which the darkest colour of the render exceeds that of the photo
FRONT = 0.9  # of the median depth: what is nearer floats before the surface
FADE = 0.5  # factor of their opacities


@torch.no_grad()
def veils(fit: Fit) -> Tensor:
    """Which Gaussians lie before the surface at a hazy pixel of a training view, bool `(N,)`."""
    views = fit.scene.train
    means = fit.model.means.detach().cpu()
    pixels, depths = project_points(means, views.cameras)
    found = torch.zeros(len(means), dtype=torch.bool)
    for view in range(len(views)):
        shown, photo, _ = views.compared(view, views.render(view, fit.render))
        is_hazy = (darkest(shown[0]) - darkest(photo) > HAZE).cpu()
        surface = fit.median_depth(views.camera(view))
        height, width = surface.shape
        x, y, is_inside = nearest_pixels(pixels[:, view], depths[:, view], width, height)
        found |= is_inside & is_hazy[y, x] & (depths[:, view] < FRONT * surface[y, x])
    return found


def darkest(image: Tensor) -> Tensor:
    """The dark channel of an image `(3, H, W)`: the least number within `WINDOW` pixels in any channel, `(H, W)`."""
    darkness: Tensor = max_pool2d(1 - image.amin(0)[None], WINDOW, stride=1, padding=WINDOW // 2)
    return 1 - darkness[0]
