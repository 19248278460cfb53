"""How far the film and the viewer of the page go: as far as two photos show most of what is seen."""

from dataclasses import replace

import numpy as np
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.datasets.splits import select_evenly
from kgs.fit.fit import Fit
from kgs.geometry.cameras import image_size, posed, resized, select, to
from kgs.geometry.rigs import camera_centers
from kgs.metrics.coverage import MIN_VIEWS, views_that_show

from .cameras import rolled, shown_poses
from .film import camera_path

_SIDE = 64  # pixels of the longer side of the images in which it is measured
_MOST = 24  # photos that are asked what they show
_LEAST = 0.9  # of the share of the best camera; below it the film and the ends of the arc show needles and fog
_STEPS = 16  # of a path between two cameras


def film_views(fit: Fit, roll: float = 0.0) -> tuple[Views, int]:
    """The training views from where the film and the page's viewer pass them, and the index of the best.

    The best camera is the one of whose image at least `MIN_VIEWS` training photos show the largest share. One of which
    they show less than `_LEAST` of that moves along the path of a film towards the nearest that shows enough, until it
    does, too.

    `roll` turns the pictures, see :func:`kgs.app.files.cameras.rolled`.
    """
    views = rolled(fit.scene.train, roll)
    cameras = posed(views.cameras, shown_poses(fit.scene.train, roll))
    poses, best = _within_reach(fit, cameras)
    return replace(views, cameras=posed(cameras, poses)), best


def _within_reach(fit: Fit, cameras: PinholeCamera) -> tuple[Tensor, int]:
    """The poses of the cameras, those that show too little moved towards others, and the index of the best."""
    scale = _SIDE / max(image_size(cameras))
    height, width = (max(1, round(scale * side)) for side in image_size(cameras))
    small = to(resized(cameras, scale, (height, width)), "cpu")
    asked = select_evenly(small.batch_size, min(small.batch_size, _MOST))
    depths = [fit.render_with_depth(select(small, i))[1] for i in range(small.batch_size)]
    asked_depths = [depths[i] for i in asked]

    def share(camera: PinholeCamera, depth: Tensor) -> float:
        return float((views_that_show(depth, camera, asked_depths, select(small, asked)) >= MIN_VIEWS).float().mean())

    poses = small.extrinsics.clone()
    shares = [share(select(small, i), depth) for i, depth in enumerate(depths)]
    best = int(np.argmax(shares))
    least = _LEAST * shares[best]
    halfway = np.linspace(0, 0.5, _STEPS + 1)  # of the path there and back
    centers = camera_centers(poses)
    enough = [i for i, shown in enumerate(shares) if shown >= least]
    for i, shown in enumerate(shares):
        if shown >= least:
            continue
        nearest = min(enough, key=lambda k: float((centers[k] - centers[i]).norm()))
        target = small.extrinsics[nearest]
        poses[i] = target
        if float(small.extrinsics[i, 2, :3] @ target[2, :3]) > 0:  # else the path would lead through the scene
            way = camera_path(small.extrinsics[[i, nearest]], halfway, depth=1.0).to(poses)
            for pose in way[:-1]:
                camera = posed(select(small, i), pose[None])
                if share(camera, fit.render_with_depth(camera)[1]) >= least:
                    poses[i] = pose
                    break
    return poses.to(cameras.extrinsics), best
