"""Rigs: where cameras stand, how they are turned, and what they look at."""

import torch
from torch import Tensor

from kgs._support.checks import check_tensor
from kgs._support.errors import ArgumentError


def camera_centers(extrinsics: Tensor) -> Tensor:
    """The centres of cameras in the world, `(C, 3)` float64 on the CPU, from world-to-camera matrices `(C, 4, 4)`."""
    poses = extrinsics.detach().double().cpu()
    return -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]


def camera_extent(extrinsics: Tensor) -> float:
    """Size of a camera rig: 1.1 times the largest distance of a camera's centre to the mean of the centres.

    Source: the normalisation of NeRF++ (Zhang et al., 2020) as 3D Gaussian Splatting uses it; over training cameras.

    Convention:
        World-to-camera extrinsics; the direction of the axes does not matter.

    Args:
        extrinsics: matrices [R | t] with a rotation R, `(C, 4, 4)`, C >= 1, else a ValueError.

    Returns:
        The extent in world units; 0 for a single camera.
    """
    check_tensor("extrinsics", extrinsics)
    if extrinsics.ndim != 3 or extrinsics.shape[-2:] != (4, 4) or len(extrinsics) == 0:
        raise ArgumentError("extrinsics", "shape (C, 4, 4) with C >= 1", tuple(extrinsics.shape))
    centres = camera_centers(extrinsics)
    return 1.1 * float((centres - centres.mean(dim=0)).norm(dim=1).max())


def common_up(extrinsics: Tensor) -> Tensor:
    """The mean up direction of cameras `(C, 4, 4)`, `(3,)` float64 of length 1; the first one's where they disagree."""
    ups = -extrinsics[:, 1, :3].detach().double().cpu()
    mean = ups.mean(dim=0)
    up = mean if mean.norm() > 0.1 else ups[0]
    unit: Tensor = up / up.norm()
    return unit


def meeting_point(extrinsics: Tensor) -> Tensor | None:
    """The point nearest to all optical axes, `(3,)` float64; None where axes are near-parallel, or it is behind one.

    Convention:
        World-to-camera extrinsics, OpenCV axes, `(V, 4, 4)`. Axes within about 5 degrees count as parallel.
    """
    poses = torch.linalg.inv(extrinsics.double().cpu())
    centers = poses[:, :3, 3]
    axes = poses[:, :3, 2]
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    if torch.linalg.eigvalsh(across.mean(0))[0] <= 0.005:
        return None
    meeting = torch.linalg.solve(across.sum(0), (across @ centers[..., None]).sum(0)[:, 0])
    in_front = (((meeting - centers) * axes).sum(1) > 0).all()
    return meeting if bool(in_front) else None


def degrees_between(rotations: Tensor, others: Tensor) -> Tensor:
    """The angles by which rotations `(..., 3, 3)` differ, `(...)`; |R - S| is 2 sqrt(2) times the sine of its half."""
    sines: Tensor = torch.linalg.matrix_norm(rotations - others) / 8**0.5
    return 2 * sines.clamp(max=1).asin().rad2deg()
