"""Feature tracks of posed images: SIFT keypoints, matched along epipolar lines and joined over the views.

Source: D. Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004 (the ratio test).
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Self

import cv2
import numpy as np
import torch
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.epipolar import fundamental_from_projections
from torch import Tensor

from kgs._support.progress import ProgressBar, silent
from kgs.backends import get_backend
from kgs.datasets.scene import Views
from kgs.init_points.keypoints import root_sift

from .matching import match

SMALL_IMAGE = 200_000  # pixels; SIFT sees smaller images at twice their size, which gives 1.5 to 4 times the points


@dataclass(frozen=True, eq=False)
class Tracks:
    """T scene points as V views see them; on the CPU."""

    pixels: Tensor  # `(T, V, 2)`, float64; the first pixel's centre is (0, 0)
    visible: Tensor  # `(T, V)`: whether a view sees a point

    def select(self, rows: Tensor) -> Self:
        """Some of the points, by a mask or by indices."""
        return type(self)(self.pixels[rows], self.visible[rows])


def find_tracks(views: Views, bar: ProgressBar = silent, backend: str = "auto") -> Tracks:
    """Find points that at least two of the views see, at usable pixels.

    Two keypoints match if each is the other's nearest in RootSIFT among those near its epipolar line (under the given
    poses), clearly nearer than the second nearest, and near enough in itself. The best matches are joined first; one
    that would give a track two pixels in one view is left out. Nothing is random: equal images give equal bits.
    """
    # The cost of matching grows with the squares of both counts, so many views get fewer keypoints each.
    limit = min(max(48_000 // len(views), 1500), 12_000)
    features = [detect(views, view, limit) for view in bar(range(len(views)), "keypoints", "view")]
    projections = (views.cameras.intrinsics.double() @ views.cameras.extrinsics.double())[:, :3].cpu()
    nodes, pixels, owners = _distinct_pixels([pixels for pixels, _ in features])
    kernels = get_backend(backend, pixels.device, required=False)
    links = list[tuple[float, int, int]]()
    for i, j in bar(list(combinations(range(len(views)), 2)), "matches", "pair"):
        pixels1, descriptors1 = features[i]
        pixels2, descriptors2 = features[j]
        lines = _lines(pixels1, projections[i], projections[j])
        distances, rows, columns = match(lines, pixels2.float(), descriptors1, descriptors2, kernels)
        links += zip(distances.tolist(), nodes[i][rows].tolist(), nodes[j][columns].tolist(), strict=True)
    tracks = _join(links, owners)
    track_pixels = torch.zeros(len(tracks), len(views), 2, dtype=torch.float64)
    visible = torch.zeros(len(tracks), len(views), dtype=torch.bool)
    for row, track in enumerate(tracks):
        columns = torch.tensor(list(track))
        track_pixels[row, columns] = pixels[torch.tensor(list(track.values()))]
        visible[row, columns] = True
    return Tracks(track_pixels, visible)


def detect(views: Views, index: int, limit: int) -> tuple[Tensor, Tensor]:
    """Pixels `(N, 2)` in float64 and RootSIFT descriptors `(N, 128)` of the strongest keypoints of one view."""
    image = views.images[index].permute(1, 2, 0).cpu().numpy()
    grey = cv2.cvtColor((image.clip(0, 1) * 255).round().astype(np.uint8), cv2.COLOR_RGB2GRAY)
    usable = views.usable
    mask = None if usable is None else usable[index].cpu().numpy().astype(np.uint8)
    factor = 2 if grey.size < SMALL_IMAGE else 1
    keypoints = root_sift(grey, limit, factor, mask, nOctaveLayers=4, contrastThreshold=0.005)
    return keypoints.pixels, keypoints.descriptors


def _lines(pixels: Tensor, projection1: Tensor, projection2: Tensor) -> Tensor:
    """The epipolar lines in the second view of pixels in the first, `(N, 3)` float32, with normals of length 1."""
    fundamental = fundamental_from_projections(projection1[None], projection2[None])[0]
    lines = convert_points_to_homogeneous(pixels) @ fundamental.T
    unit: Tensor = (lines / lines[:, :2].norm(dim=1, keepdim=True)).float()
    return unit


def _distinct_pixels(pixels: list[Tensor]) -> tuple[list[Tensor], Tensor, list[int]]:
    """For each view the number of each keypoint's pixel; then all distinct pixels, and their views, by number.

    SIFT repeats a keypoint for each of its orientations: these share one pixel.
    """
    numbers = list[Tensor]()
    distinct = list[Tensor]()
    owners = list[int]()
    for view, of_view in enumerate(pixels):
        unique, inverse = torch.unique(of_view, dim=0, return_inverse=True)
        numbers.append(inverse + len(owners))
        distinct.append(unique)
        owners += [view] * len(unique)
    return numbers, torch.cat(distinct), owners


def _join(links: list[tuple[float, int, int]], owners: list[int]) -> list[dict[int, int]]:
    """Join nodes to tracks (union-find), nearest descriptors first; a track maps each of its views to a node."""
    parents = list(range(len(owners)))
    tracks = [{view: node} for node, view in enumerate(owners)]

    def root(node: int) -> int:
        while parents[node] != node:
            parents[node] = parents[parents[node]]
            node = parents[node]
        return node

    for _, node1, node2 in sorted(links):
        one = root(node1)
        other = root(node2)
        if one != other and not tracks[one].keys() & tracks[other].keys():
            parents[other] = one
            tracks[one] |= tracks[other]
            tracks[other] = {}
    return [track for track in tracks if len(track) > 1]
