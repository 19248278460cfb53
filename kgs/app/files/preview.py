"""A still of a splat, in the size in which messengers show links and files."""

from collections.abc import Callable
from pathlib import Path

import cv2
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.json_files import write_whole
from kgs.datasets.scene import Views
from kgs.geometry.cameras import resized
from kgs.geometry.rigs import camera_centers

from .images import eight_bits

WIDTH = 1200
HEIGHT = 630
_QUALITY = 90  # of the JPEG


def write_preview(path: Path, render: Callable[[PinholeCamera], Tensor], views: Views) -> None:
    """Write what the camera nearest the middle of all sees, as a JPEG of 1200 x 630 pixels. The write is atomic.

    The middle of its photo is shown, as much of it as fills that shape. `render` makes an image `(1, 3, H, W)`.
    """
    centers = camera_centers(views.cameras.extrinsics)
    nearest = int((centers - centers.mean(0)).norm(dim=1).argmin())
    height, width = views.images.shape[-2:]
    scale = max(WIDTH / width, HEIGHT / height)
    middle = (scale * width - WIDTH) / 2, (scale * height - HEIGHT) / 2
    image = render(resized(views.camera(nearest), scale, (HEIGHT, WIDTH), middle))
    _, content = cv2.imencode(".jpg", eight_bits(image[0]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    write_whole(path, content.tobytes())
