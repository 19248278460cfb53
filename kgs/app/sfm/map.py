"""Cameras and points from matches, by COLMAP's incremental mapper with settings for few photos.

Source: J. Schoenberger and J.-M. Frahm, Structure-from-motion revisited, CVPR 2016. Settings that differ from COLMAP's
were measured (docs/results/cameras). Each step runs on one thread, so that the same photos give the same bits.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mode
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .colmap import pycolmap
from .pycolmap_processes import check_space

MAX_ERROR = 1.5  # largest reprojection error, in pixels
_FIRST_PAIR_DEGREES = 2.0  # least angle between the first two photos; COLMAP's 16 fails on photos that face one way
_FIRST_PAIR_DEGREES_AGAIN = 0.2  # the same in a second attempt, if the first one registers no pair
_ROUNDS = 5  # at most, each of registering photos with the lens held and then adjusting it
_CONVERGED = 0.01  # relative change of the focal length, and change of the distortion, at which rounds end
_USUAL_DISTORTION = 0.05  # radial; larger ones have to explain much of the errors
_DISTORTION_GAIN = 0.1  # share of the squared errors that a larger distortion has to explain
_WRONG_FOCAL = 1.25  # factor by which the focal length is made wrong to see whether points still fit


class Cameras(NamedTuple):
    """What one solver found. Poses are world-to-camera with OpenCV axes, by the photos' names."""

    focals: dict[str, float]  # focal length in pixels of each photo's lens
    rotations: dict[str, NDArray[np.float64]]  # (3, 3) each
    centers: dict[str, NDArray[np.float64]]  # (3,) each, in the world
    points: dict[str, int]  # how many points a photo sees
    reconstruction: Any  # pycolmap's
    focal_rise: float  # relative growth of the squared errors with a wrong focal length; infinite where it was given

    @property
    def focal(self) -> float:
        """The focal length in pixels of most photos."""
        return mode(self.focals.values())


NO_CAMERAS = Cameras({}, {}, {}, {}, None, 0.0)  # of a solver that registered no photo


@dataclass(frozen=True)
class Solver:
    """COLMAP's mapper with the matches of one database."""

    database: Path  # with verified matches, and a first guess of each lens
    images: Path  # the folder of the photos
    work: Path  # a folder for what the mapper writes
    seed: int  # of its random choices

    def solve(
        self,
        names: Mapping[str, str],  # of the photos to register, by those of the images in the database
        focals: Sequence[float] = (),  # of each lens in pixels if they are known; (): they are adjusted
        *,
        attempt: int = 0,  # added to the seed
        first_pair: tuple[str, str] | None = None,  # images that are registered first; None: the mapper chooses
        start: Cameras | None = None,
        at_least: int = 0,  # photos that have to be registered; where the first round has fewer, there are none
    ) -> Cameras:
        """Cameras and points of as many photos as can be registered: `NO_CAMERAS` if no pair can be.

        Lenses are held while photos are registered, because two photos do not determine them, and adjusted to all of
        them after that. This is repeated with the lenses that came out until they no longer change. With a `start`,
        cameras of other matches, their points are triangulated from the matches of the database before any photo is
        registered, and then the cameras are adjusted to these.
        """
        best = None
        error = 0.0
        is_held = len(focals) > 0
        with pycolmap.Database.open(self.database) as file:
            guesses = file.read_all_cameras()
            lenses = {lens.camera_id: lens for lens in file.read_all_cameras()}
            for camera_id, focal in zip(sorted(lenses), focals, strict=is_held):
                lenses[camera_id].focal_length = focal
            options = _mapper_options(list(names), self.seed + attempt)
            if first_pair:
                ids = {image.name: image.image_id for image in file.read_all_images()}
                options.init_image_id1, options.init_image_id2 = (ids[image] for image in first_pair)
                options.init_num_trials = 1
            for _ in range(_ROUNDS if start is None else 1):
                for lens in lenses.values():
                    file.update_camera(lens)
                if start is None:
                    scene = self._map(options, free=not is_held)
                else:
                    scene = self._map_from(_reconstruction(file, start, names), options)
                if scene is None or scene.num_reg_images() < at_least or (best is not None and _is_worse(scene, best)):
                    break
                best, error = _adjust(scene, is_held)
                changes = [_change(lenses[camera_id], lens) for camera_id, lens in best.cameras.items()]
                for camera_id, lens in best.cameras.items():
                    lenses[camera_id].params = lens.params
                if max(changes) < _CONVERGED:
                    break
            for lens in guesses:
                file.update_camera(lens)
        if best is None:
            return NO_CAMERAS
        return cameras_of(best, names, math.inf if is_held else _focal_rise(best, error))

    def _map(self, options: Any, free: bool) -> Any:
        """The reconstruction of most photos with the lenses of the database, or None.

        If `free`, the second attempt adjusts focal lengths while it registers photos.
        """
        for degrees, refine in ((_FIRST_PAIR_DEGREES, False), (_FIRST_PAIR_DEGREES_AGAIN, free)):
            options.mapper.init_min_tri_angle = degrees
            options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = refine
            if (scene := self._run_mapper(options)) is not None:
                return scene
        return None

    def _map_from(self, start: Any, options: Any) -> Any:
        """The reconstruction of the photos whose cameras are known, and of those that its points then register."""
        known = self.work / "start"
        known.mkdir(parents=True, exist_ok=True)
        points = pycolmap.triangulate_points(start, self.database, self.images, known, options=options)
        points.write_binary(known)
        return self._run_mapper(options, known)

    def _run_mapper(self, options: Any, start: str | Path = "") -> Any:
        """The reconstruction with most registered photos, or None. The mapper goes on from `start`."""
        try:
            scenes = pycolmap.incremental_mapping(self.database, self.images, self.work, options, start)
        except (RuntimeError, ValueError):  # the mapper gives up
            check_space(self.database.parent)
            return None
        return max(scenes.values(), key=lambda scene: scene.num_reg_images(), default=None)


def cameras_of(reconstruction: Any, names: Mapping[str, str], focal_rise: float) -> Cameras:
    """The cameras of a reconstruction by the photos' names, in the order of `names`."""
    images = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    registered = {name: images[image] for image, name in names.items() if image in images}
    poses = {name: image.cam_from_world().matrix() for name, image in registered.items()}
    return Cameras(
        {name: float(reconstruction.cameras[image.camera_id].focal_length) for name, image in registered.items()},
        {name: pose[:, :3] for name, pose in poses.items()},
        {name: -pose[:, :3].T @ pose[:, 3] for name, pose in poses.items()},
        {name: int(image.num_points3D) for name, image in registered.items()},
        reconstruction,
        focal_rise,
    )


def _mapper_options(images: list[str], seed: int) -> Any:
    """The settings with which the mapper registers these images of a database."""
    options = pycolmap.IncrementalPipelineOptions()
    options.image_names = images
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.multiple_models = False
    options.min_model_size = 2
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.min_num_matches = 10
    options.mapper.init_min_num_inliers = 20
    options.mapper.abs_pose_min_num_inliers = 12
    options.mapper.filter_max_reproj_error = MAX_ERROR
    options.triangulation.complete_max_reproj_error = options.triangulation.merge_max_reproj_error = MAX_ERROR
    options.mapper.init_max_error = 2.0
    options.mapper.abs_pose_max_error = 4.0
    options.triangulation.ignore_two_view_tracks = False  # of three photos, most points are seen by two
    return options


def _reconstruction(file: Any, cameras: Cameras, names: Mapping[str, str]) -> Any:
    """A reconstruction with these cameras and the keypoints of a database; its points are still to be found."""
    scene = pycolmap.Reconstruction()
    ids = {image.name: image.image_id for image in file.read_all_images()}
    for lens in cameras.reconstruction.cameras.values():
        scene.add_camera_with_trivial_rig(lens)
    for image in cameras.reconstruction.images.values():
        if image.has_pose and names.get(image.name) in cameras.rotations:
            image_id = ids[image.name]
            keypoints = file.read_keypoints(image_id)[:, :2]
            new = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=image.camera_id, image_id=image_id)
            scene.add_image_with_trivial_frame(new, image.cam_from_world())
    return scene


def _change(before: Any, after: Any) -> float:
    """The relative change of a lens's focal length, or that of its distortion if this is larger."""
    focal = abs(after.params[0] / before.params[0] - 1)
    distortion = abs(after.params[3] - before.params[3])
    return float(max(focal, distortion))


def _is_worse(scene: Any, best: Any) -> bool:
    """Whether a reconstruction has fewer photos than the best one so far, or less than half of its points."""
    return bool(scene.num_reg_images() < best.num_reg_images() or 2 * scene.num_points3D() < best.num_points3D())


def _adjust(reconstruction: Any, is_held: bool) -> tuple[Any, float]:
    """Bundle adjustment with radial distortions that are usual or explain enough of the errors, else with 0.

    Photos that hardly determine the focal length trade it against a distortion that no camera has. If `is_held`, the
    focal lengths stay.
    """
    distorted, error = _bundle_adjust(reconstruction, hold_focal=is_held)
    if max(abs(lens.params[3]) for lens in distorted.cameras.values()) <= _USUAL_DISTORTION:
        return distorted, error
    undistorted, larger_error = _bundle_adjust(reconstruction, hold_focal=is_held, distortion=0.0)
    if larger_error > (1 + _DISTORTION_GAIN) * error:
        return distorted, error
    return undistorted, larger_error


def _bundle_adjust(
    reconstruction: Any,
    *,
    hold_focal: bool,
    hold_distortion: bool = False,
    factor: float = 1.0,  # by which focal lengths are multiplied first
    distortion: float | None = None,  # at which the radial distortions are held
) -> tuple[Any, float]:
    """A copy, adjusted until it converges, and half its sum of squared errors in pixels."""
    scene = copy.deepcopy(reconstruction)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    options.refine_focal_length = not hold_focal
    options.refine_extra_params = not hold_distortion and distortion is None
    config = pycolmap.BundleAdjustmentConfig()
    for lens in scene.cameras.values():
        focal, x, y, own = lens.params
        lens.params = [factor * focal, x, y, own if distortion is None else distortion]
    for image in scene.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    done: Any = pycolmap.create_default_ceres_bundle_adjuster(options, config, scene).solve()
    return scene, float(done.ceres_summary.final_cost) if done.num_residuals else 0.0


def _focal_rise(reconstruction: Any, error: float) -> float:
    """The relative growth of the sum of squared errors with focal lengths 1.25 times too long or too short.

    The smaller of the two counts; all else but the distortion is adjusted to the wrong focal lengths. Near 0 the photos
    do not determine them: the scene is stretched instead.
    """
    wrong = min(
        _bundle_adjust(reconstruction, hold_focal=True, hold_distortion=True, factor=factor)[1]
        for factor in (_WRONG_FOCAL, 1 / _WRONG_FOCAL)
    )
    return wrong / max(error, np.finfo(np.float64).tiny) - 1
