"""Points from feature tracks: SIFT keypoints, matched along the epipolar lines, joined over the views, triangulated.

Sources: D. Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004 (keypoints, ratio test);
R. Arandjelovic and A. Zisserman, Three things everyone should know to improve object retrieval, CVPR 2012 (RootSIFT);
R. Hartley and A. Zisserman, Multiple View Geometry, section 12.2 (the direct linear transformation).
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Self

import cv2
import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_to_homogeneous
from kornia.geometry.epipolar import fundamental_from_projections
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.fit.progress import Stage, silent

SMALL_IMAGE = 200_000  # pixels; SIFT sees smaller images at twice their size, which gives 1.5 to 4 times the points
MAX_LINE_DISTANCE = 1.5  # pixels, from an epipolar line
CHUNK = 256  # keypoints matched at once: bounds the memory
MAX_RATIO = 0.8  # of the best descriptor distance to the second best
MAX_DISTANCE = 0.4  # between descriptors of length 1: a match without a rival must still be alike


@dataclass(frozen=True)
class Tracks:
    """T scene points as V views see them: at `pixels` `(T, V, 2)`, float64, where `seen` `(T, V)`; on the CPU.

    Convention:
        Integer pixel centres: the first pixel's centre is (0, 0).
    """

    pixels: Tensor
    seen: Tensor

    def select(self, rows: Tensor) -> Self:
        """Some of the points, by a mask or by numbers."""
        return type(self)(self.pixels[rows], self.seen[rows])


def find_tracks(views: Views, stage: Stage = silent) -> Tracks:
    """Find points that at least two of the views see, where the views' masks, if any, are above 0.5.

    Two keypoints match if each is the other's nearest in RootSIFT among those near its epipolar line (under the given
    poses), clearly nearer than the second nearest, and alike in itself. The best matches are joined first; one that
    would give a track two places in one view is left out. Nothing is random: the same images give the same bits.
    """
    # The cost of matching grows with the squares of both counts, so many views get fewer keypoints each.
    limit = min(max(48_000 // len(views), 1500), 12_000)
    features = [_detect(views, view, limit) for view in stage(range(len(views)), "keypoints", "view")]
    cameras = views.cameras
    projections = (cameras.intrinsics.double() @ cameras.extrinsics.double())[:, :3].cpu()
    nodes, pixels, owners = _places([places for places, _ in features])
    links = list[tuple[float, int, int]]()
    for i, j in stage(list(combinations(range(len(views)), 2)), "matches", "pair"):
        distances, rows, columns = _match(features[i], features[j], projections[i], projections[j])
        links += zip(distances.tolist(), nodes[i][rows].tolist(), nodes[j][columns].tolist(), strict=True)
    tracks = _join(links, owners)
    table = torch.zeros(len(tracks), len(views), 2, dtype=torch.float64)
    seen = torch.zeros(len(tracks), len(views), dtype=torch.bool)
    for row, track in enumerate(tracks):
        columns = torch.tensor(list(track))
        table[row, columns] = pixels[torch.tensor(list(track.values()))]
        seen[row, columns] = True
    return Tracks(table, seen)


def _detect(views: Views, index: int, limit: int) -> tuple[Tensor, Tensor]:
    """Places `(N, 2)` in float64 and RootSIFT descriptors `(N, 128)` of the strongest keypoints of one view."""
    image = views.images[index].permute(1, 2, 0).cpu().numpy()
    grey = cv2.cvtColor((image.clip(0, 1) * 255).round().astype(np.uint8), cv2.COLOR_RGB2GRAY)
    mask = None if views.masks is None else (views.masks[index, 0] > 0.5).cpu().numpy().astype(np.uint8)
    factor = 2 if grey.size < SMALL_IMAGE else 1
    if factor > 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
        mask = None if mask is None else mask.repeat(factor, 0).repeat(factor, 1)
    # enable_precise_upscale: without it OpenCV's keypoints are a quarter of a pixel off.
    sift = cv2.SIFT_create(  # type: ignore[attr-defined]  # not in the stubs
        nfeatures=limit, nOctaveLayers=4, contrastThreshold=0.005, enable_precise_upscale=True
    )
    keypoints, descriptors = sift.detectAndCompute(grey, mask)
    if not keypoints:
        return torch.zeros(0, 2, dtype=torch.float64), torch.zeros(0, 128)
    places = torch.tensor([keypoint.pt for keypoint in keypoints], dtype=torch.float64)
    descriptors = torch.nn.functional.normalize(torch.from_numpy(descriptors), p=1.0, dim=1).sqrt()
    return (places + 0.5) / factor - 0.5, descriptors


def _match(
    first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor], projection1: Tensor, projection2: Tensor
) -> tuple[Tensor, ...]:
    """Descriptor distances and the keypoints' numbers in both views, each `(M,)`, of the matches between two views."""
    (places1, descriptors1), (places2, descriptors2) = first, second
    fundamental = fundamental_from_projections(projection1[None], projection2[None])[0]
    lines = convert_points_to_homogeneous(places1) @ fundamental.T
    lines = (lines / lines[:, :2].norm(dim=1, keepdim=True)).float()
    targets = convert_points_to_homogeneous(places2).float().T
    candidates = [(torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64), torch.zeros(0))]
    for start in range(0, len(lines), CHUNK):
        near_line = (lines[start : start + CHUNK] @ targets).abs_() < MAX_LINE_DISTANCE
        rows, columns = near_line.nonzero().unbind(1)
        # One pair in about a hundred is left: a tenth of the work of all descriptor distances.
        differences = descriptors1.index_select(0, rows + start) - descriptors2.index_select(0, columns)
        candidates.append((rows + start, columns, differences.square_().sum(1).sqrt_()))
    rows, columns, distances = (torch.cat(parts) for parts in zip(*candidates, strict=True))
    nearest1, rival1 = _nearest(distances, rows, len(places1))
    nearest2, rival2 = _nearest(distances, columns, len(places2))
    distinct = distances < MAX_RATIO * torch.minimum(rival1, rival2)
    good = nearest1 & nearest2 & distinct & (distances < MAX_DISTANCE)
    return distances[good], rows[good], columns[good]


def _nearest(distances: Tensor, owners: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """For each candidate: is it the nearest of its owner, and the distance of its owner's second nearest."""
    order = torch.arange(len(distances))
    infinite = distances.new_full((count,), torch.inf)
    ties = distances == infinite.scatter_reduce(0, owners, distances, "amin")[owners]
    first = order.new_full((count,), len(order)).scatter_reduce(0, owners[ties], order[ties], "amin")
    nearest = first[owners] == order
    rival = infinite.scatter_reduce(0, owners[~nearest], distances[~nearest], "amin")
    return nearest, rival[owners]


def _places(places: list[Tensor]) -> tuple[list[Tensor], Tensor, list[int]]:
    """Number the distinct places of all views: numbers by keypoint, places and views by number.

    SIFT gives a keypoint with several orientations once for each; all of them are one place.
    """
    numbers, distinct, owners = list[Tensor](), list[Tensor](), list[int]()
    for view, all_places in enumerate(places):
        unique, inverse = torch.unique(all_places, dim=0, return_inverse=True)
        numbers.append(inverse + len(owners))
        distinct.append(unique)
        owners += [view] * len(unique)
    return numbers, torch.cat(distinct), owners


def _join(links: list[tuple[float, int, int]], owners: list[int]) -> list[dict[int, int]]:
    """Join places to tracks (union-find), nearest descriptors first; a track maps each of its views to a place."""
    parents = list(range(len(owners)))
    tracks = [{view: place} for place, view in enumerate(owners)]

    def root(place: int) -> int:
        while parents[place] != place:
            parents[place] = parents[parents[place]]
            place = parents[place]
        return place

    for _, place1, place2 in sorted(links):
        one, other = root(place1), root(place2)
        if one != other and not tracks[one].keys() & tracks[other].keys():
            parents[other] = one
            tracks[one] |= tracks[other]
            tracks[other] = {}
    return [track for track in tracks if len(track) > 1]


def triangulate(tracks: Tracks, cameras: PinholeCamera) -> Tensor:
    """The points `(T, 3)` in float64 that the tracks see, from the null vectors of their projection equations.

    Each is seen by at least two views. They are not finite, or behind cameras, where the rays do not meet.
    """
    intrinsics, extrinsics = matrices(cameras)
    # Unit focal lengths and an origin amid the cameras keep the equations well conditioned.
    origin = camera_centers(cameras).mean(0)
    rotations, translations = extrinsics[:, :3, :3], extrinsics[:, :3, :3] @ origin + extrinsics[:, :3, 3]
    projections = torch.cat([rotations, translations[..., None]], dim=-1)
    rays = (torch.linalg.inv(intrinsics) @ convert_points_to_homogeneous(tracks.pixels)[..., None])[..., 0]
    equations = rays[..., :2, None] * projections[:, None, 2] - projections[:, :2]
    equations = (equations * tracks.seen[..., None, None]).flatten(1, 2)
    null = torch.linalg.svd(equations, full_matrices=False).Vh[:, -1]
    points: Tensor = null[:, :3] / null[:, 3:] + origin
    return points


def triangulate_certain(
    tracks: Tracks, cameras: PinholeCamera, max_error: float = 0.75, min_angle: float = 1.0
) -> tuple[Tensor, Tracks]:
    """Triangulate, leave out what contradicts it, and keep the points whose depth is certain, with their tracks.

    An observation goes if its camera has the point behind it or twice `max_error` pixels or more away from its pixel;
    the points are then found once more, and one that has an observation `max_error` or more away goes, as does one
    that fewer than two views are left to see, or whose rays all lie within `min_angle` degrees.
    """
    for limit in (2.0 * max_error, max_error):
        points = triangulate(tracks, cameras)
        pixels, depths = project_all(points, cameras)
        fits = (depths > 0) & ((pixels - tracks.pixels).norm(dim=-1) < limit)
        agreeing = (fits | ~tracks.seen).all(1)
        kept = tracks.seen & fits
        enough = kept.sum(1) >= 2
        points, agreeing = points[enough], agreeing[enough]
        tracks = Tracks(tracks.pixels[enough], kept[enough])
    certain = agreeing & (_widest_angles(points, tracks.seen, cameras) >= min_angle)
    return points[certain], tracks.select(certain)


def project_all(points: Tensor, cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    """Pixels `(P, V, 2)` and depths `(P, V)` of P points in V cameras, float64; pixels mean nothing at depth <= 0."""
    intrinsics, extrinsics = matrices(cameras)
    local = torch.einsum("vij,pj->pvi", extrinsics[:, :3, :3], points.double()) + extrinsics[:, :3, 3]
    image = torch.einsum("vij,pvj->pvi", intrinsics, local)
    return image[..., :2] / image[..., 2:], local[..., 2]


def unproject(pixels: Tensor, depths: Tensor, views: Tensor, cameras: PinholeCamera) -> Tensor:
    """The places in the world `(P, 3)` of pixels `(P, 2)` at depths `(P,)`, each in the camera of its view, float64."""
    intrinsics, extrinsics = matrices(cameras)
    rays = convert_points_to_homogeneous(pixels.double())
    local = (torch.linalg.inv(intrinsics)[views] @ rays[..., None])[..., 0] * depths[:, None]
    world: Tensor = (local - extrinsics[views, :3, 3])[:, None] @ extrinsics[views, :3, :3]
    return world[:, 0]


def matrices(cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    """Intrinsics `(V, 3, 3)` and world-to-camera extrinsics `(V, 4, 4)` in float64 on the CPU."""
    return cameras.intrinsics[:, :3, :3].double().cpu(), cameras.extrinsics.double().cpu()


def camera_centers(cameras: PinholeCamera) -> Tensor:
    """The centres of V cameras in the world, `(V, 3)` in float64."""
    _, extrinsics = matrices(cameras)
    return -(extrinsics[:, :3, :3].mT @ extrinsics[:, :3, 3:])[..., 0]


def _widest_angles(points: Tensor, seen: Tensor, cameras: PinholeCamera) -> Tensor:
    """Degrees between the two most different rays of each point, `(P,)`."""
    rays = torch.nn.functional.normalize(points[:, None] - camera_centers(cameras), dim=-1)
    cosines = (rays @ rays.mT).masked_fill(~(seen[:, :, None] & seen[:, None, :]), 1.0).flatten(1).amin(1)
    return cosines.clamp(-1.0, 1.0).acos().rad2deg()
