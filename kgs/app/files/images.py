"""Converts RGB to 8-bit BGR, as OpenCV writes it to files and films."""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def eight_bits(image: Tensor) -> NDArray[np.uint8]:
    """An RGB or RGBA image `(3 or 4, H, W)`, as BGR or BGRA `(H, W, 3 or 4)`.

    Floating point is clamped to [0, 1] and rounded; 8 bits stay as they are.
    """
    levels = image if image.dtype == torch.uint8 else image.detach().clamp(0, 1).mul_(255).round_().byte()
    red, green, blue, *alpha = levels.cpu().numpy()
    return np.asarray(cv2.merge([blue, green, red, *alpha]), np.uint8)
