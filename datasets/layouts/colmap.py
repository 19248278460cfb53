"""Scenes with a COLMAP model: `sparse/0` (binary or text) beside `images/`.

Sources: https://colmap.github.io/format.html, https://colmap.github.io/cameras.html.
"""

from __future__ import annotations

from pathlib import Path

import kornia.geometry as kg
import torch
from torch import Tensor

from kgs.datasets.frames import NO_POINTS, Frame, PointCloud, build_scene, path_inside, split_frames
from kgs.datasets.images import Intrinsics, image_folder
from kgs.datasets.scene import Scene
from kgs.errors import DataError

from .colmap_model import ColmapCamera, ColmapImage, find_model, model_file, read_cameras, read_images, read_points

__all__ = ["camera_to_world", "load_colmap", "track_points"]


def load_colmap(
    root: Path,
    train_views: int | None = None,
    downscale: float | None = None,
    background: str = "black",
    points: str = "none",
) -> Scene:
    """Load a scene whose lenses and poses come from a COLMAP model; distorted lenses are undone.

    Convention:
        COLMAP's poses are world-to-camera with OpenCV axes already; its first pixel's centre is at (0.5, 0.5).

    Args:
        root: the folder with `sparse/0` or `sparse`, and the photos.
        train_views: how many views to train on (see `split_by_name`).
        downscale: how many times smaller the images shall be.
        background: "black" or "white", behind transparent images.
        points: "none", or "model-points" for those of the model's points that two training views observe.

    Raises:
        DataError: the model or a photo is missing, damaged, or they do not fit.
        ValueError: train_views is out of range.
    """
    folder = find_model(root)
    if folder is None:
        raise DataError(root, "", "expected a COLMAP model in sparse/0 or sparse, found none")
    cameras_file, images_file = model_file(folder, "cameras"), model_file(folder, "images")
    cameras, images = read_cameras(cameras_file), read_images(images_file)
    photos, frames = image_folder(root), []
    for image in images.values():
        if image.camera_id not in cameras:
            raise DataError(images_file, image.name, f"has camera {image.camera_id}, which {cameras_file.name} lacks")
        path = path_inside(images_file, root, image.name, photos)
        if not path.is_file() and (root / image.name).is_file():
            path = path_inside(images_file, root, image.name)
        lens = _intrinsics(cameras[image.camera_id])
        frames.append(Frame(images_file, image.name, path, lens, camera_to_world(image)))
    train, test = split_frames(root, frames, train_views)
    cloud = NO_POINTS
    if points == "model-points":
        ids = list(images)
        cloud = track_points(folder, {ids[i] for i in train})
    return build_scene(root, [frames[i] for i in train], [frames[i] for i in test], downscale, background, cloud)


def camera_to_world(image: ColmapImage) -> Tensor:
    """The pose of a registered photo, `(4, 4)` float64 camera-to-world with OpenCV axes."""
    quat = torch.tensor(image.quat, dtype=torch.float64)
    rotation = kg.quaternion_to_rotation_matrix(quat)[None] * (1.0 if float(quat.norm()) > 0 else torch.nan)
    translation = torch.tensor(image.translation, dtype=torch.float64)[None, :, None]
    return kg.Rt_to_matrix4x4(*kg.worldtocam_to_camtoworld_Rt(rotation, translation))[0]


def track_points(folder: Path, image_ids: set[int]) -> PointCloud:
    """The points of a model that at least two of the given images observe, as first points.

    Their positions were refined with all images, test views among them: `kind` says "model-points".
    """
    points, colors = read_points(model_file(folder, "points3D"), image_ids)
    return PointCloud(torch.from_numpy(points), torch.from_numpy(colors).float() / 255.0, "model-points")


def _intrinsics(camera: ColmapCamera) -> Intrinsics:
    numbers = camera.params
    if camera.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        numbers = (numbers[0], *numbers)
    fx, fy, cx, cy, *distortion = numbers
    # Radial models end with k1 or k1, k2; OpenCV's order has p1, p2 next, which are 0 then.
    if camera.model in ("SIMPLE_RADIAL", "RADIAL"):
        distortion = [*distortion, 0.0, 0.0, 0.0][:4]
    fisheye = camera.model == "OPENCV_FISHEYE"
    return Intrinsics(camera.width, camera.height, fx, fy, cx, cy, tuple(distortion), fisheye)
