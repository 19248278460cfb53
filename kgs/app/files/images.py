"""Converts float RGB to 8-bit BGR, as OpenCV writes it to files and films."""

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor


def eight_bits(image: Tensor) -> NDArray[np.uint8]:
    """An RGB or RGBA image `(3 or 4, H, W)`, clamped to [0, 1] and rounded, as BGR or BGRA `(H, W, 3 or 4)`."""
    red, green, blue, *alpha = image.detach().clamp(0, 1).mul_(255).round_().byte().cpu().numpy()
    return np.asarray(cv2.merge([blue, green, red, *alpha]), np.uint8)
