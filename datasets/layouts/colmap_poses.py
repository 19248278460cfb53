"""Where the photos of a COLMAP model were taken, and whether its files agree on it.

Source: https://colmap.github.io/rigs.html. From version 3.12 on, a model has frames, what a rig of cameras saw at once,
with the rig's pose, and rigs, with their cameras' poses. COLMAP then passes over the poses in images.*.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import kornia.geometry as kg
import torch
from torch import Tensor

from kgs._support.errors import DataError

from .colmap_model import STEMS, ColmapImage, ColmapPose, model_file, read_frames, read_images, read_rigs

_PARTS = ("frames", "rigs")  # that newer versions add to a model
_OTHER = {".bin": ".txt", ".txt": ".bin"}
_SAME = 1e-5  # relative: half of float32's digits. What poses differ by less, of the rotation or the way, is rounding.


@dataclass(frozen=True, eq=False)
class Registered:
    """The photos of a model by their ids, and their poses in the same order, `(P, 4, 4)` float64 camera-to-world.

    Convention:
        OpenCV axes.
    """

    images: dict[int, ColmapImage]
    poses: Tensor  # those that COLMAP takes: of the frames and rigs where the model has both
    own_poses: Tensor  # those in images.*, which programs take that do not know frames
    notes: tuple[str, ...]  # about what is not used


def registered_images(folder: Path) -> Registered:
    """The photos of the model in a folder. A DataError where its frames and rigs leave the pose of a photo open.

    Convention:
        In the files, poses are from the world to the camera.
    """
    source = model_file(folder, "images")
    images = read_images(source)
    own = _matrices(source, [(image.name, image.pose) for image in images.values()])
    poses = own
    copies = [source.with_stem(stem).with_suffix(_OTHER[source.suffix]) for stem in (*STEMS, *_PARTS)]
    copies = [path for path in copies if path.is_file()]
    unused = [path.name for path in copies if path.stem in _PARTS or path != model_file(path.parent, path.stem)]
    notes: tuple[str, ...] = (f"not used: {', '.join(unused)}; the model is read from {source.name}",) if unused else ()
    parts = [source.with_stem(stem) for stem in _PARTS]
    given = [part for part in parts if part.is_file()]
    if len(given) == 1:
        (missing,) = (part.name for part in parts if part not in given)
        notes += (f"{given[0].name} is not used: there is no {missing} beside it",)
    elif given and images and (found := _poses_of_frames(images, *parts)) is not None:
        poses, gone = found
        if gone:
            notes += (f"photos of {parts[0].name} that {source.name} lacks are left out: {gone}",)
        limit = torch.full((4, 4), _SAME, dtype=torch.float64)
        limit[:3, 3] *= poses[:, :3, 3].abs().max()
        if differing := int(((own - poses).abs() > limit).any(dim=2).any(dim=1).sum()):
            which = f"the poses of {differing} of {len(images)} photos in {source.name} are not used"
            notes += (f"{which}: {parts[0].name} and {parts[1].name} give others, which COLMAP takes",)
    return Registered(images, kg.inverse_transformation(poses), kg.inverse_transformation(own), notes)


def _poses_of_frames(
    images: Mapping[int, ColmapImage], frames_file: Path, rigs_file: Path
) -> tuple[Tensor, int] | None:
    """The poses from world to camera by the frames and rigs, and how many photos of the frames images.* lacks.

    None where both files are empty: COLMAP then takes the poses in images.*.
    """
    frames = read_frames(frames_file)
    rigs = read_rigs(rigs_file)
    if not frames and not rigs:
        return None
    rig_poses: dict[int, tuple[str, ColmapPose]] = {}  # by image: of the rig from the world, of the camera from the rig
    camera_poses: dict[int, tuple[str, ColmapPose]] = {}
    gone = 0
    for frame_id, frame in frames.items():
        if frame.rig_id not in rigs:
            raise DataError(frames_file, f"frame {frame_id}", f"a rig of {rigs_file.name}", frame.rig_id)
        for image_id, camera_id in frame.cameras.items():
            if image_id not in images:  # it was taken out of the model
                gone += 1
                continue
            name = images[image_id].name
            if image_id in rig_poses:
                raise DataError(frames_file, name, "each image in one frame", "it in two")
            if camera_id != images[image_id].camera_id:
                raise DataError(frames_file, name, f"camera {images[image_id].camera_id} as in images.*", camera_id)
            if (pose := rigs[frame.rig_id].get(camera_id)) is None:
                raise DataError(rigs_file, name, f"the pose of camera {camera_id} in rig {frame.rig_id}", "none")
            rig_poses[image_id] = (f"frame {frame_id}", frame.pose)
            camera_poses[image_id] = (f"rig {frame.rig_id}", pose)
    if lacking := [image.name for image_id, image in images.items() if image_id not in rig_poses]:
        advice = f"where the poses in images.* are right, remove {frames_file.name} and {rigs_file.name}"
        raise DataError(frames_file, lacking[0], "each image in a frame", f"{len(lacking)} in none", advice=advice)
    camera_from_rig = _matrices(rigs_file, [camera_poses[image_id] for image_id in images])
    rig_from_world = _matrices(frames_file, [rig_poses[image_id] for image_id in images])
    return camera_from_rig @ rig_from_world, gone


def _matrices(source: Path, poses: Sequence[tuple[str, ColmapPose]]) -> Tensor:
    """Poses, each with what an error names, as matrices `(P, 4, 4)` float64.

    A DataError where numbers are not finite, or all of a quaternion's are 0.
    """
    quats = torch.tensor([pose.quat for _, pose in poses], dtype=torch.float64).reshape(-1, 4)
    translations = torch.tensor([pose.translation for _, pose in poses], dtype=torch.float64).reshape(-1, 3, 1)
    matrices = kg.Rt_to_matrix4x4(kg.quaternion_to_rotation_matrix(quats), translations)
    for (what, _), is_valid in zip(poses, quats.any(dim=1) & matrices.isfinite().all(dim=(1, 2)), strict=True):
        if not is_valid:
            raise DataError(source, what, "a finite 4x4 pose")
    return matrices
