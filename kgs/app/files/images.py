"""Converts float RGB to 8-bit BGR, as OpenCV writes it to files and films."""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


def eight_bits(image: Tensor) -> NDArray[np.uint8]:
    """An RGB or RGBA image `(3 or 4, H, W)`, clamped to [0, 1] and rounded, as BGR or BGRA `(H, W, 3 or 4)`."""
    pixels = (image.detach().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
    return np.ascontiguousarray(pixels[:, :, [2, 1, 0, 3][: pixels.shape[2]]])
