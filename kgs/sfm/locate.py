"""Where a photo was taken, found against a fit: what it shows in common with the training views, and PnP."""

from typing import Any

import cv2
import numpy as np
import torch
from kornia.feature import match_smnn
from kornia.geometry.camera import PinholeCamera

from kgs.datasets.scene import Views, pinholes
from kgs.fit.trainer import Trainer
from kgs.geometry import camera_matrices, unproject
from kgs.init_points.tracks import detect

KEYPOINTS = 4000  # in each picture
RATIO = 0.85  # of the distances to the nearest and the second nearest descriptor, both ways
PIXELS = 2.0  # a point farther from where the camera would have it is an outlier
LEAST = 12  # points that have to agree


def locate(trainer: Trainer, photos: Views) -> PinholeCamera | None:
    """The camera of the one photo in `photos`, whose given pose is not looked at; None where too little agrees.

    Keypoints of the photo are matched with those of each training view, whose places in space are where the median
    depth of the fit puts them. The pose is that of RANSAC over EPnP, refined on its inliers (OpenCV).

    Convention:
        Kornia's, as of `Views`: world-to-camera, integer pixel centres; the world is that of the fit.
    """
    train, (intrinsics, _) = trainer.scene.train, camera_matrices(photos.cameras)
    places, descriptors = detect(photos, 0, KEYPOINTS)
    points, pixels = list[torch.Tensor](), list[torch.Tensor]()
    for view in range(len(train)):
        others, known = detect(train, view, KEYPOINTS)
        if min(len(places), len(others)) < 2:
            continue
        _, pairs = match_smnn(descriptors, known, RATIO)
        here, there = pairs.unbind(1)
        depth = trainer.median_depth(train.camera(view))
        column, row = others[there].round().long().unbind(1)
        depths = depth[row.clamp(0, depth.shape[0] - 1), column.clamp(0, depth.shape[1] - 1)].double()
        found = depths > 0
        points.append(
            unproject(others[there][found], depths[found], torch.full((int(found.sum()),), view), train.cameras)
        )
        pixels.append(places[here][found])
    space, image = (torch.cat(parts).numpy() if parts else np.zeros((0, 1)) for parts in (points, pixels))
    if len(space) < LEAST:
        return None
    cv2.setRNGSeed(0)
    rules: dict[str, Any] = {
        "iterationsCount": 2000,
        "reprojectionError": PIXELS,
        "confidence": 0.9999,
        "flags": cv2.SOLVEPNP_EPNP,
    }
    matrix = intrinsics[0].numpy()
    good, turn, shift, inliers = cv2.solvePnPRansac(space, image, matrix, None, **rules)
    if not good or inliers is None or len(inliers) < LEAST:
        return None
    rows = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(space[rows], image[rows], matrix, None, turn, shift)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = torch.from_numpy(cv2.Rodrigues(turn)[0]), torch.from_numpy(shift[:, 0])
    size = int(photos.images.shape[-2]), int(photos.images.shape[-1])
    return pinholes(photos.cameras.intrinsics, pose.float()[None], size)
