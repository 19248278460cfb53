"""Scenes with a COLMAP model: `sparse/0` beside `images/`, or its files beside the photos.

Source: https://colmap.github.io/cameras.html.
"""

from contextlib import suppress
from pathlib import Path

import torch

from kgs._support.errors import DataError, listed
from kgs.datasets.folders import find_models, image_folder
from kgs.datasets.frames import Frame, FrameSet, PointCloud, find_file
from kgs.datasets.image_file import ImageFile, read_bytes
from kgs.datasets.images import Intrinsics

from .colmap_model import ColmapCamera, model_file, read_cameras, read_images, read_points
from .colmap_poses import registered_images

# With the names of the test views: 3DGS has the first one beside the model, nerfstudio the other in the scene's folder.
_TEST_LISTS = ("test.txt", "test_list.txt")


def load(root: Path, photo_folder: str = "") -> FrameSet:
    """Read the COLMAP model of a scene, of several the largest one.

    Photos that are gone are left out with a note, unless more than half of them are. The photos that a list names are
    test views.

    Convention:
        COLMAP's first pixel has its centre at (0.5, 0.5).
    """
    folder, notes = largest_model(root)
    cameras_file = model_file(folder, "cameras")
    images_file = model_file(folder, "images")
    cameras = read_cameras(cameras_file)
    registered = registered_images(folder)
    notes += registered.notes
    photos = image_folder(root, photo_folder)
    frames = []
    ids = {}
    for (image_id, image), pose in zip(registered.images.items(), registered.poses, strict=True):
        if image.camera_id not in cameras:
            raise DataError(images_file, image.name, f"a camera of {cameras_file.name}", image.camera_id)
        path = find_file(images_file, root, image.name, photos)
        if not path.is_file() and not photo_folder:
            beside = find_file(images_file, root, image.name)
            path = beside if beside.is_file() else path
        lens = _intrinsics(cameras[image.camera_id])
        frames.append(Frame(images_file, image.name, ImageFile(path), lens, pose))
        ids[path] = image_id
    gone = [frame.name for frame in frames if not frame.path.is_file()]
    if 0 < len(gone) <= len(frames) / 2:
        notes += (f"left out, because the file is gone: {len(gone)} of {len(frames)} photos ({listed(gone)})",)
        frames = [frame for frame in frames if frame.path.is_file()]
    train, test, on_list = _split_by_list(root, folder, frames)
    notes += on_list
    return FrameSet(train, test, model_points=lambda t: track_points(folder, {ids[f.path] for f in t}), notes=notes)


def _split_by_list(
    root: Path, folder: Path, frames: list[Frame]
) -> tuple[list[Frame], list[Frame] | None, tuple[str, ...]]:
    """The training and test views that a list of names leaves, in the order of their names, and notes on the list.

    Without a list, or if it leaves one of them empty, all frames and None.
    """
    lists = [path for path in (at / name for name in _TEST_LISTS for at in (folder, root)) if path.is_file()]
    if not lists:
        return frames, None, ()
    names = {line.strip() for line in read_bytes(lists[0]).decode("utf-8-sig", "replace").splitlines()} - {""}
    by_name = sorted(frames, key=lambda frame: frame.name)
    train = [frame for frame in by_name if frame.name not in names]
    test = [frame for frame in by_name if frame.name in names]
    if not train or not test:
        return frames, None, (f"{lists[0].name} is not used: it names {len(test)} of {len(frames)} photos",)
    unknown = sorted(names.difference(frame.name for frame in test))
    notes = (f"{lists[0].name} names photos that are not there: {listed(unknown)}",) if unknown else ()
    return train, test, notes


def largest_model(root: Path) -> tuple[Path, tuple[str, ...]]:
    """The folder of the COLMAP model with most images, of a scene that has one, and a note about the others."""
    folders = find_models(root)
    if len(folders) == 1:
        return folders[0], ()
    counts = dict.fromkeys(folders, 0)
    for folder in folders:
        with suppress(DataError):  # a damaged one
            counts[folder] = len(read_images(model_file(folder, "images")))
    largest = max(folders, key=counts.__getitem__)
    others = [f"{folder.relative_to(root)} has {counts[folder]}" for folder in folders if folder != largest]
    name = largest.relative_to(root)
    note = f"{name} is the COLMAP model that is read, with {counts[largest]} images: {listed(others)}"
    return largest, (note,)


def track_points(folder: Path, image_ids: set[int]) -> PointCloud:
    """The points that at least two of the given images observe; their positions were refined with all images."""
    points, colors = read_points(model_file(folder, "points3D"), image_ids)
    return PointCloud(torch.from_numpy(points), torch.from_numpy(colors).float() / 255.0, "model-points")


def _intrinsics(camera: ColmapCamera) -> Intrinsics:
    numbers = camera.params
    model = camera.model
    if model.startswith(("SIMPLE_", "RADIAL")):
        numbers = (numbers[0], *numbers)
    fx, fy, cx, cy, *distortion = numbers
    is_fisheye = model.endswith("FISHEYE")
    # Radial models end with k1 or k1, k2, other fisheyes may have none; what OpenCV's order has next is 0 then.
    if "RADIAL" in model or is_fisheye:
        distortion = [*distortion, 0.0, 0.0, 0.0, 0.0][:4]
    return Intrinsics(camera.width, camera.height, fx, fy, cx, cy, tuple(distortion), is_fisheye)
