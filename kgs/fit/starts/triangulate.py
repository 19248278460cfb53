"""Points from tracks in known cameras, and back: triangulation, projection, and how certain the depth is.

Source: R. Hartley and A. Zisserman, Multiple View Geometry, section 12.2 (the direct linear transformation).
"""

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import convert_points_to_homogeneous
from torch import Tensor

from kgs.camera import camera_centers

from .tracks import Tracks

MAX_ERROR = 0.75  # pixels between a point and its observation
MIN_ANGLE = 1.0  # degrees between the two most different rays of a point


def triangulate(tracks: Tracks, cameras: PinholeCamera) -> Tensor:
    """The points `(T, 3)`, float64, of tracks in two views or more; not finite, or behind, where rays do not meet."""
    intrinsics, extrinsics = matrices(cameras)
    # Unit focal lengths and an origin amid the cameras keep the equations well conditioned.
    origin = camera_centers(cameras.extrinsics).mean(0)
    rotations, translations = extrinsics[:, :3, :3], extrinsics[:, :3, :3] @ origin + extrinsics[:, :3, 3]
    projections = torch.cat([rotations, translations[..., None]], dim=-1)
    rays = (torch.linalg.inv(intrinsics) @ convert_points_to_homogeneous(tracks.pixels)[..., None])[..., 0]
    equations = (rays[..., :2, None] * projections[:, None, 2] - projections[:, :2]) * tracks.seen[..., None, None]
    null = torch.linalg.svd(equations.flatten(1, 2), full_matrices=False).Vh[:, -1]
    points: Tensor = null[:, :3] / null[:, 3:] + origin
    return points


def triangulate_certain(tracks: Tracks, cameras: PinholeCamera) -> tuple[Tensor, Tracks]:
    """Triangulate, leave out what contradicts it, and keep the points whose depth is certain, with their tracks.

    Observations go that are behind their camera, or twice `MAX_ERROR` or more away from their pixel; points then found
    once more go with an observation `MAX_ERROR` away, with fewer than two views, or with rays all within `MIN_ANGLE`.
    """
    for limit in (2.0 * MAX_ERROR, MAX_ERROR):
        points = triangulate(tracks, cameras)
        pixels, depths = project_all(points, cameras)
        fits = (depths > 0) & ((pixels - tracks.pixels).norm(dim=-1) < limit)
        agreeing = (fits | ~tracks.seen).all(1)
        kept = tracks.seen & fits
        enough = kept.sum(1) >= 2
        points, agreeing = points[enough], agreeing[enough]
        tracks = Tracks(tracks.pixels[enough], kept[enough])
    rays = torch.nn.functional.normalize(points[:, None] - camera_centers(cameras.extrinsics), dim=-1)
    cosines = (rays @ rays.mT).masked_fill(~(tracks.seen[:, :, None] & tracks.seen[:, None, :]), 1.0).flatten(1).amin(1)
    certain = agreeing & (cosines.clamp(-1.0, 1.0).acos().rad2deg() >= MIN_ANGLE)
    return points[certain], tracks.select(certain)


def project_all(points: Tensor, cameras: PinholeCamera) -> tuple[Tensor, Tensor]:
    """Pixels `(P, V, 2)` and depths `(P, V)` of P points in V cameras, float64; pixels mean nothing at depth <= 0."""
    intrinsics, extrinsics = matrices(cameras)
    local = torch.einsum("vij,pj->pvi", extrinsics[:, :3, :3], points.double()) + extrinsics[:, :3, 3]
    image = torch.einsum("vij,pvj->pvi", intrinsics, local)
    return image[..., :2] / image[..., 2:], local[..., 2]


def picture_places(pixels: Tensor, depths: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Whole pixels x and y `(P,)` of a picture, and whether they are in it, before the camera; x and y are 0 outside.

    Convention:
        Integer pixel centres, rounded half to even.
    """
    places = pixels.round()
    inside = ((places >= 0) & (places < torch.tensor([width, height]))).all(1) & (depths > 0)
    x, y = torch.where(inside[:, None], places, 0.0).long().unbind(1)
    return x, y, inside


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
