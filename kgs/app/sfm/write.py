"""Photos and cameras as files, as COLMAP has them: PNGs, and a binary model that is upright and scaled."""

import errno
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from kgs._support.errors import DataError
from kgs.app.files.outputs import write_png
from kgs.datasets.layouts.colmap_model import read_cameras, read_images, read_points

from .colmap import pycolmap
from .map import Cameras, cameras_of
from .pycolmap_processes import check_space
from .read import Photo

_COUNTERCLOCKWISE = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # as the picture turns


def write_images(folder: Path, photos: list[Photo], names: list[str], opaque: bool = False) -> None:
    """Write the photos, or these over black, as plain PNGs: another JPEG compression would lose detail."""
    for photo, name in zip(photos, names, strict=True):
        pixels = photo.opaque() if opaque else photo.pixels
        write_png(folder / name, torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1))


def write_masks(folder: Path, photos: list[Photo], names: list[str]) -> None:
    """Write masks of all photos if any has one, named as COLMAP wants them: as the photo, with .png behind.

    COLMAP skips photos that have none: their masks are white.
    """
    if all(photo.mask is None for photo in photos):
        return
    folder.mkdir()
    for photo, name in zip(photos, names, strict=True):
        kept = np.full(photo.pixels.shape[:2], 255, np.uint8) if photo.mask is None else photo.mask
        write_png(folder / f"{name}.png", torch.from_numpy(np.ascontiguousarray(kept)).expand(3, -1, -1))


def upright(cameras: Cameras, turned: set[str], names: Mapping[str, str]) -> Cameras:
    """The cameras with those of photos that were turned clockwise turned back: other lenses for these."""
    if turned.isdisjoint(cameras.rotations):
        return cameras
    scene = cameras.reconstruction
    found = pycolmap.Reconstruction()
    count = max(scene.cameras)
    for camera_id, lens in scene.cameras.items():
        focal, x, y, distortion = lens.params
        other = pycolmap.Camera.create_from_model_name(
            count + camera_id, "SIMPLE_RADIAL", focal, lens.height, lens.width
        )
        other.params = [focal, y, lens.width - x, distortion]
        found.add_camera_with_trivial_rig(lens)
        found.add_camera_with_trivial_rig(other)
    back = pycolmap.Rigid3d(pycolmap.Rotation3d(_COUNTERCLOCKWISE), np.zeros(3))
    for image_id, image in scene.images.items():
        if not image.has_pose:
            continue
        lens = scene.cameras[image.camera_id]
        is_turned = names[image.name] in turned
        keypoints = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        pose = image.cam_from_world()
        if is_turned:
            keypoints = np.stack([keypoints[:, 1], lens.width - keypoints[:, 0]], 1)
            pose = back * pose
        camera_id = lens.camera_id + is_turned * count
        new = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=camera_id, image_id=image_id)
        found.add_image_with_trivial_frame(new, pose)
    for point_id, point in scene.points3D.items():
        found.add_point3D_with_id(point_id, point)
    return cameras_of(found, names, cameras.focal_rise)


def level_and_scale(cameras: Cameras) -> None:
    """Turn, scale and move the world: up is the cameras' common up, the median depth of a seen point is 1.

    Convention:
        OpenCV's axes: afterwards y points down and, for the first photo, z forward as far as that is level. The origin
        is the mean of the cameras' centres.
    """
    scene = cameras.reconstruction
    names = list(cameras.rotations)
    first = cameras.rotations[names[0]]
    up = -sum(rotation[1] for rotation in cameras.rotations.values())
    turned = leveling(first @ up) @ first
    depths = list[NDArray[np.float64]]()  # of the points that each photo sees
    for image in scene.images.values():
        pose = image.cam_from_world().matrix()
        points = [scene.points3D[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
        depths.append(np.array(points).reshape(-1, 3) @ pose[2, :3] + pose[2, 3])
    scale = 1.0 / float(np.median(np.concatenate(depths)))
    center = np.mean([cameras.centers[name] for name in names], axis=0)
    scene.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(turned), -scale * turned @ center))


def write_model(folder: Path, cameras: Cameras, images: Path) -> None:
    """Write cameras, images and points with tracks and colours as COLMAP's binary files.

    Raises:
        OSError: a file was not written whole; COLMAP itself does not say so.
    """
    folder.mkdir(parents=True)
    cameras.reconstruction.extract_colors_for_all_images(images)
    cameras.reconstruction.write_binary(folder)
    try:
        read_cameras(folder / "cameras.bin")
        read_points(folder / "points3D.bin", set(read_images(folder / "images.bin")))
    except DataError as error:
        check_space(folder)
        raise OSError(errno.EIO, "COLMAP's model was not written whole", str(folder)) from error


def leveling(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The smallest rotation that turns a vector to -y. Of a vector of length 0 it is the identity.

    One that points to +y is first turned by half a turn about z, the view of an upside-down camera.
    """
    length = float(np.linalg.norm(up))
    if not length:
        return np.eye(3)
    target = np.array([0.0, -1.0, 0.0])
    cosine = float(up @ target) / length
    if cosine < -0.99:
        half = np.diag([-1.0, -1.0, 1.0])
        return np.asarray(leveling(half @ up) @ half)
    x, y, z = np.cross(up / length, target)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine))
