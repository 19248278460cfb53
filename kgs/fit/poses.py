"""Pose refinement: the poses of the training cameras as parameters of a fit, where they are only roughly known.

Convention:
    World-to-camera extrinsics. A motion is six numbers in a camera's own frame, as of Kornia's `Se3`: a translation in
    units of `TRANSLATION` median depths of the initial points, and a rotation in radians.
"""

import math
from dataclasses import replace
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3
from torch import Tensor

from kgs._support.errors import ArgumentError
from kgs.datasets.scene import Scene
from kgs.geometry.cameras import posed
from kgs.geometry.rigs import camera_centers, degrees_between

from .adam import Adam

# Roughly the sum of the learning rates of one camera over a whole fit: Adam moves no number much farther.
REACH = 0.004
# In median depths. Cameras that face one way can hardly tell a shift from a turn; a small unit favours the turn.
TRANSLATION = 0.3
LAST = 0.01  # the last learning rate, relative to the first


class CameraOptimizer:
    """The optimizer of the poses of V cameras, of which each step moves one a little.

    The gauge is fixed: the mean rotation, the mean centre and the spread of the centres stay as given, so that neither
    the splat nor a test camera has to follow.

    Args:
        given: the world-to-camera extrinsics that the fit starts from, `(V, 4, 4)`.
        steps: the number of steps of the whole fit.
        depth: the median depth of the initial points, in world units, above 0.

    Attributes:
        extrinsics: the current poses, `(V, 4, 4)`, float64 on the CPU.
    """

    def __init__(self, given: Tensor, steps: int, depth: float) -> None:
        self.given = given.double().cpu()
        self.depth = depth
        self._rate = REACH * len(given) / steps * -math.log(LAST) / (1 - LAST)
        self.extrinsics = self.given.clone()
        self._motions = [torch.zeros(6, dtype=torch.float64) for _ in given]  # 0 before each step
        groups = [{"params": [motion], "name": f"view {view}"} for view, motion in enumerate(self._motions)]
        self._optimizer = Adam(groups)
        self._seen: tuple[int, Tensor] | None = None

    def camera(self, camera: PinholeCamera, view: int) -> PinholeCamera:
        """The camera of a view, at any resolution, at its current pose, whose gradient the next :meth:`step` uses."""
        pose = self.extrinsics[view : view + 1].to(camera.extrinsics).requires_grad_()
        self._seen = view, pose
        return posed(camera, pose)

    @torch.no_grad()
    def step(self, progress: float) -> None:
        """Move the last result of :meth:`camera`, if its gradient is finite, at a `progress` of the fit in (0, 1]."""
        if self._seen is None or (found := self._seen[1].grad) is None or not bool(found.isfinite().all()):
            return
        view = self._seen[0]
        motion = self._motions[view]
        pose = self.extrinsics[view]
        units = torch.ones(6, dtype=torch.float64)
        units[:3] = TRANSLATION * self.depth
        gradient = found[0].double().cpu() @ pose.mT  # with respect to a matrix that multiplies the pose from the left
        turn = gradient[:3, :3] - gradient[:3, :3].mT
        motion.grad = units * torch.stack([*gradient[:3, 3], turn[2, 1], turn[0, 2], turn[1, 0]])
        for group in self._optimizer.param_groups:
            group["lr"] = decayed(self._rate, LAST * self._rate, progress)
        self._optimizer.step()
        self.extrinsics[view] = Se3.exp((units * motion)[None]).matrix()[0] @ pose
        self._seen = None
        motion.grad = None
        motion.zero_()
        self._fix_gauge()

    def moved(self) -> dict[str, float]:
        """How far the cameras moved: mean and maximum, rotations in degrees, shifts as shares of the median depth."""
        degrees = degrees_between(self.extrinsics[:, :3, :3], self.given[:, :3, :3])
        shares = (camera_centers(self.extrinsics) - camera_centers(self.given)).norm(dim=1) / self.depth
        found = {"degrees": degrees.mean(), "max_degrees": degrees.max()}
        found |= {"depths": shares.mean(), "max_depths": shares.max()}
        return {name: round(float(value), 5) for name, value in found.items()}

    def state_dict(self) -> dict[str, Any]:
        """All that the next steps depend on besides the arguments of the class."""
        return {"extrinsics": self.extrinsics, "optimizer": self._optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a :meth:`state_dict`. A KeyError, TypeError or ValueError if an entry is missing or wrong."""
        extrinsics = state["extrinsics"]
        if extrinsics.shape != self.given.shape:
            raise ArgumentError("poses", f"extrinsics {tuple(self.given.shape)}", tuple(extrinsics.shape))
        self.extrinsics = extrinsics.double().clone()
        self._optimizer.load_state_dict(state["optimizer"])

    def _fix_gauge(self) -> None:
        """Turn, move and scale the world so that mean rotation, mean centre and spread of the centres are as given."""
        now = self.extrinsics
        left, _, right = torch.linalg.svd((now[:, :3, :3].mT @ self.given[:, :3, :3]).sum(dim=0))
        turn = (left @ right).mT  # rotation of the world
        centers = camera_centers(now)
        wanted = camera_centers(self.given)
        spreads = [(points - points.mean(dim=0)).norm() for points in (centers, wanted)]
        scale = spreads[1] / spreads[0] if float(min(spreads)) > 1e-9 * self.depth else 1.0
        now[:, :3, :3] @= turn.mT
        centers = scale * (centers - centers.mean(dim=0)) @ turn.mT + wanted.mean(dim=0)
        now[:, :3, 3] = -(now[:, :3, :3] @ centers[..., None])[..., 0]


def with_extrinsics(scene: Scene, extrinsics: Tensor) -> Scene:
    """The scene with training cameras at other poses, `(V, 4, 4)`."""
    cameras = scene.train.cameras
    return replace(scene, train=replace(scene.train, cameras=posed(cameras, extrinsics.to(cameras.extrinsics))))


def decayed(first: float, last: float, progress: float) -> float:
    """Log-linear interpolation between two rates: `first` at progress 0, `last` at 1."""
    return math.exp((1 - progress) * math.log(first) + progress * math.log(last))
