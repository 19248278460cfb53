"""How well matches of two photos fit their cameras."""

import cv2
import numpy as np
import torch
from kornia.geometry.epipolar import fundamental_from_projections, sampson_epipolar_distance
from torch import Tensor

from kgs.datasets import Views


def sampson_distances(views: Views, first: int, second: int, ratio: float) -> Tensor:
    """Of SIFT matches that pass Lowe's ratio test, in pixels, from the fundamental matrix of the two cameras."""
    sift = cv2.SIFT_create()
    points = []
    descriptors = []
    for i in (first, second):
        image = (views.images[i].permute(1, 2, 0) * 255).round().byte().numpy()
        keypoints, described = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
        points.append(np.array([keypoint.pt for keypoint in keypoints]))
        descriptors.append(described)
    pairs = cv2.BFMatcher().knnMatch(*descriptors, k=2)
    good = [best for best, rival in pairs if best.distance < ratio * rival.distance]
    x = torch.from_numpy(points[0][[match.queryIdx for match in good]])
    y = torch.from_numpy(points[1][[match.trainIdx for match in good]])
    projections = views.cameras.intrinsics[:, :3, :3].double() @ views.cameras.extrinsics[:, :3].double()
    fundamental = fundamental_from_projections(projections[first, None], projections[second, None])
    return sampson_epipolar_distance(x[None], y[None], fundamental, squared=False)[0]
