"""A picture as files and films hold it."""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


def eight_bits(image: Tensor) -> NDArray[np.uint8]:
    """An RGB or RGBA image `(3 or 4, H, W)`, clamped to [0, 1] and rounded, as OpenCV has it: `(H, W, 3 or 4)`, BGR."""
    pixels = (image.detach().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
    return np.ascontiguousarray(pixels[:, :, [2, 1, 0, 3][: pixels.shape[2]]])
