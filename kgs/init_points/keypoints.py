"""SIFT keypoints with RootSIFT descriptors; small images can be enlarged first.

Sources: D. Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004; R. Arandjelovic and
A. Zisserman, Three things everyone should know to improve object retrieval, CVPR 2012 (RootSIFT).
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class Keypoints(NamedTuple):
    """N keypoints of one image."""

    pixels: Tensor  # `(N, 2)` float64; the first pixel's centre is (0, 0)
    sizes: Tensor  # `(N,)` float64, pixels
    angles: Tensor  # `(N,)` float64, degrees
    descriptors: Tensor  # `(N, 128)` float32, of length 1


def root_sift(
    grey: NDArray[Any], max_count: int, factor: int = 1, mask: NDArray[np.uint8] | None = None, **thresholds: Any
) -> Keypoints:
    """The strongest SIFT keypoints of an image, up to `max_count`; nothing is random.

    Args:
        grey: `(H, W)`, 8 bits.
        max_count: the largest number of keypoints.
        factor: the image is enlarged by this whole number first.
        mask: `(H, W)`, keypoints lie where it is not 0; None: everywhere.
        thresholds: of the detector, as keyword arguments of `cv2.SIFT_create`.
    """
    if factor > 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
        if mask is not None:
            mask = mask.repeat(factor, 0).repeat(factor, 1)
    # enable_precise_upscale: without it OpenCV's keypoints are a quarter of a pixel off.
    sift = cv2.SIFT_create(nfeatures=max_count, enable_precise_upscale=True, **thresholds)  # type: ignore[attr-defined]  # no stub
    keypoints, descriptors = sift.detectAndCompute(grey, mask)
    rows = [(*keypoint.pt, keypoint.size, keypoint.angle) for keypoint in keypoints]
    numbers = torch.tensor(rows, dtype=torch.float64).reshape(-1, 4)
    vectors = torch.zeros(0, 128) if descriptors is None else torch.from_numpy(descriptors)
    unit = torch.nn.functional.normalize(vectors, p=1.0, dim=1).sqrt()
    return Keypoints((numbers[:, :2] + 0.5) / factor - 0.5, numbers[:, 2] / factor, numbers[:, 3], unit)
