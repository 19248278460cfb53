"""What the poses of several cameras have in common: centres, extent, what is up, and where their axes meet."""

import torch
from torch import Tensor

from .types import check_tensor


def camera_centers(extrinsics: Tensor) -> Tensor:
    """The centres of cameras in the world, `(C, 3)` float64 on the CPU, from world-to-camera matrices `(C, 4, 4)`."""
    poses = extrinsics.detach().double().cpu()
    return -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]


def degrees_between(rotations: Tensor, others: Tensor) -> Tensor:
    """The angles by which rotations `(..., 3, 3)` differ, `(...)`; |R - S| is 2 sqrt(2) times the sine of its half."""
    sines: Tensor = torch.linalg.matrix_norm(rotations - others) / 8**0.5
    return 2 * sines.clamp(max=1).asin().rad2deg()


def common_up(extrinsics: Tensor) -> Tensor:
    """What is up for cameras `(C, 4, 4)` on the whole, or for the first where they differ: `(3,)` float64, length 1."""
    ups = -extrinsics[:, 1, :3].detach().double().cpu()
    up = ups.mean(dim=0) if ups.mean(dim=0).norm() > 0.1 else ups[0]
    unit: Tensor = up / up.norm()
    return unit


def meeting_point(extrinsics: Tensor) -> Tensor | None:
    """The point nearest to all optical axes, `(3,)` float64; None where axes are near-parallel, or it is behind one.

    Convention:
        World-to-camera extrinsics, OpenCV axes, `(V, 4, 4)`. Within some 5 degrees axes do not tell where they meet.
    """
    poses = torch.linalg.inv(extrinsics.double().cpu())
    centers, axes = poses[:, :3, 3], poses[:, :3, 2]
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    if torch.linalg.eigvalsh(across.mean(0))[0] <= 0.005:
        return None
    meeting = torch.linalg.solve(across.sum(0), (across @ centers[..., None]).sum(0)[:, 0])
    return meeting if bool((((meeting - centers) * axes).sum(1) > 0).all()) else None


def camera_extent(extrinsics: Tensor) -> float:
    """Size of a camera rig: 1.1 times the largest distance of a camera's centre to the mean of the centres.

    Source: the normalisation of NeRF++ (Zhang et al., 2020) as 3D Gaussian Splatting uses it; over training cameras.

    Convention:
        World-to-camera extrinsics; which way the axes point does not matter.

    Args:
        extrinsics: matrices [R | t] with a rotation R, `(C, 4, 4)`, C >= 1, else a ValueError.

    Returns:
        The extent in world units; 0 for a single camera.
    """
    check_tensor("extrinsics", extrinsics)
    if extrinsics.ndim != 3 or extrinsics.shape[-2:] != (4, 4) or len(extrinsics) == 0:
        raise ValueError(f"extrinsics: expected shape (C, 4, 4) with C >= 1, got {tuple(extrinsics.shape)}")
    centres = camera_centers(extrinsics)
    return 1.1 * float((centres - centres.mean(dim=0)).norm(dim=1).max())
