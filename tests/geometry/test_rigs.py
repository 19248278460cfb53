"""Poses of rigs whose geometry is known in closed form."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from kgs.geometry.rigs import camera_centers, camera_extent, common_up, degrees_between, meeting_point


def rig(centres, rotations):
    """World-to-camera matrices with these centres; the rows of a rotation are the camera's axes."""
    extrinsics = torch.eye(4, dtype=torch.float64).repeat(len(centres), 1, 1)
    extrinsics[:, :3, :3] = rotations
    extrinsics[:, :3, 3] = -(rotations @ centres[..., None])[..., 0]
    return extrinsics


def looking(centres, target):
    """Rotations of upright cameras with centres in the plane y = 0 that look at a point of it; y points down."""
    z = torch.nn.functional.normalize(target - centres, dim=1)
    y = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(z)
    return torch.stack([torch.linalg.cross(y, z), y, z], 1)


def turned(count, seed=0):
    return torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix())


CENTRES = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [2.0, 3.0, 0.0]], dtype=torch.float64)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_centres_and_extent_of_known_cameras(dtype):
    extrinsics = rig(CENTRES, turned(3)).to(dtype)
    centres = camera_centers(extrinsics)
    assert centres.dtype == torch.float64
    assert torch.allclose(centres, CENTRES, atol=1e-12 if dtype == torch.float64 else 1e-6)
    # mean (2, 1, 0); distances sqrt(5), sqrt(5), 2
    assert camera_extent(extrinsics) == pytest.approx(1.1 * math.sqrt(5), rel=1e-6)
    assert camera_extent(extrinsics[:1]) == 0.0


@pytest.mark.parametrize("degrees", [1e-6, 0.3, 90.0, 179.9, 180.0])
def test_angles_between_rotations(degrees):
    first = Rotation.random(4, random_state=1)
    axes = torch.nn.functional.normalize(torch.randn(4, 3, generator=torch.Generator().manual_seed(2)).double(), dim=1)
    other = first * Rotation.from_rotvec(degrees * axes.numpy(), degrees=True)
    found = degrees_between(torch.from_numpy(first.as_matrix()), torch.from_numpy(other.as_matrix()))
    # near a half turn the sine of the half angle is flat: rounding of 1e-16 becomes 1e-6 degrees
    assert torch.allclose(found, torch.full((4,), degrees, dtype=torch.float64), rtol=1e-6, atol=3e-6)


def test_up_is_the_mean_of_the_cameras_and_that_of_the_first_where_they_cancel():
    upright = looking(CENTRES, torch.tensor([1.0, 0.0, 9.0], dtype=torch.float64))
    assert torch.allclose(common_up(rig(CENTRES, upright)), torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    tilted = torch.from_numpy(Rotation.from_euler("z", [[20.0], [-20.0]], degrees=True).as_matrix())
    assert torch.allclose(common_up(rig(CENTRES[:2], tilted)), torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    opposite = torch.from_numpy(Rotation.from_euler("z", [[90.0], [-90.0]], degrees=True).as_matrix())
    assert torch.allclose(common_up(rig(CENTRES[:2], opposite)), -opposite[0, 1])


def test_cameras_around_an_object_meet_in_it_and_parallel_or_diverging_ones_nowhere():
    angles = torch.linspace(0.0, 4.0, 5, dtype=torch.float64)
    centres = torch.stack([3 * angles.sin(), torch.zeros(5, dtype=torch.float64), -3 * angles.cos()], 1)
    target = torch.tensor([0.2, 0.0, 0.1], dtype=torch.float64)
    inwards = looking(centres, target)
    assert torch.allclose(meeting_point(rig(centres, inwards)), target, atol=1e-12)
    assert meeting_point(rig(centres, inwards[:1].expand(5, 3, 3))) is None
    outwards = inwards * torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)[:, None]
    assert meeting_point(rig(centres, outwards)) is None
