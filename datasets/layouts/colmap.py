"""Scenes with a COLMAP model: `sparse/0` beside `images/` (https://colmap.github.io/cameras.html)."""

from pathlib import Path

import kornia.geometry as kg
import torch
from torch import Tensor

from kgs.datasets.folders import find_model, image_folder
from kgs.datasets.frames import Frame, FrameSet, PointCloud, path_inside
from kgs.datasets.image_file import ImageFile
from kgs.datasets.images import Intrinsics
from kgs.errors import DataError

from .colmap_model import ColmapCamera, ColmapImage, model_file, read_cameras, read_images, read_points


def load_colmap(root: Path) -> FrameSet:
    """Read the COLMAP model in `sparse/0` or `sparse`.

    Convention:
        COLMAP's poses are world-to-camera with OpenCV axes already; its first pixel's centre is at (0.5, 0.5).
    """
    folder = find_model(root) or root / "sparse"
    cameras_file, images_file = model_file(folder, "cameras"), model_file(folder, "images")
    cameras, images = read_cameras(cameras_file), read_images(images_file)
    photos, frames, ids = image_folder(root), [], {}
    for image_id, image in images.items():
        if image.camera_id not in cameras:
            raise DataError(images_file, image.name, f"has camera {image.camera_id}, which {cameras_file.name} lacks")
        path = path_inside(images_file, root, image.name, photos)
        if not path.is_file() and (root / image.name).is_file():
            path = path_inside(images_file, root, image.name)
        lens = _intrinsics(cameras[image.camera_id])
        frames.append(Frame(images_file, image.name, ImageFile(path), lens, camera_to_world(image)))
        ids[path] = image_id
    others = [p.name for p in sorted(folder.parent.iterdir()) if p.name.isdecimal() and p != folder and p.is_dir()]
    notes = (f"sparse/: only model 0 is read, not {', '.join(others[:20])}",) if folder.name == "0" and others else ()
    return FrameSet(frames, model_points=lambda t: track_points(folder, {ids[f.path] for f in t}), notes=notes)


def camera_to_world(image: ColmapImage) -> Tensor:
    """The pose of a registered photo, `(4, 4)` float64 camera-to-world with OpenCV axes."""
    quat = torch.tensor(image.quat, dtype=torch.float64)
    rotation = kg.quaternion_to_rotation_matrix(quat)[None] * (1.0 if float(quat.norm()) > 0 else torch.nan)
    translation = torch.tensor(image.translation, dtype=torch.float64)[None, :, None]
    return kg.Rt_to_matrix4x4(*kg.worldtocam_to_camtoworld_Rt(rotation, translation))[0]


def track_points(folder: Path, image_ids: set[int]) -> PointCloud:
    """The points that at least two of the given images observe; their positions were refined with all images."""
    points, colors = read_points(model_file(folder, "points3D"), image_ids)
    return PointCloud(torch.from_numpy(points), torch.from_numpy(colors).float() / 255.0, "model-points")


def _intrinsics(camera: ColmapCamera) -> Intrinsics:
    numbers, model = camera.params, camera.model
    if model.startswith(("SIMPLE_", "RADIAL")):
        numbers = (numbers[0], *numbers)
    fx, fy, cx, cy, *distortion = numbers
    # Radial models end with k1 or k1, k2; what OpenCV's order has next (p1, p2; k3, k4 of a fisheye) is 0 then.
    if "RADIAL" in model:
        distortion = [*distortion, 0.0, 0.0, 0.0][:4]
    return Intrinsics(camera.width, camera.height, fx, fy, cx, cy, tuple(distortion), model.endswith("FISHEYE"))
