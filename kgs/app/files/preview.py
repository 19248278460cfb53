"""A still of a splat, in the size in which messengers show links and files."""

from dataclasses import replace
from pathlib import Path

import cv2

from kgs._support.json_files import write_whole
from kgs.datasets.scene import Views
from kgs.fit.fit import Fit
from kgs.geometry.cameras import resized

from .images import eight_bits

WIDTH = 1200
HEIGHT = 630
_QUALITY = 90  # of the JPEG


def write_preview(path: Path, fit: Fit, views: Views, index: int) -> None:
    """Write what one of the views sees, as a JPEG of 1200 x 630 pixels. The write is atomic.

    The middle of its photo is shown, as much of it as fills that shape.
    """
    height, width = views.images.shape[-2:]
    scale = max(WIDTH / width, HEIGHT / height)
    middle = (scale * width - WIDTH) / 2, (scale * height - HEIGHT) / 2
    # Of a smaller photo it is the image of the fit, enlarged, as in the page's viewer: without the needles within.
    options = replace(fit.options, eps2d=fit.options.eps2d * max(1.0, scale) ** 2)
    image = replace(fit, options=options).render(resized(views.camera(index), scale, (HEIGHT, WIDTH), middle))
    _, content = cv2.imencode(".jpg", eight_bits(image[0]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    write_whole(path, content.tobytes())
