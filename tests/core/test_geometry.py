"""Poses of rigs whose geometry is known in closed form, and distances between points."""

import math

import numpy as np
import pytest
import torch
import trimesh
from factories import random_cloud as cloud
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from kgs.camera import pinhole_cameras
from kgs.geometry import (
    ViewGeometry,
    camera_centers,
    camera_extent,
    common_up,
    degrees_between,
    log_spacing,
    meeting_point,
    project_points,
    unproject,
)
from kgs.model import GaussianModel


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


def test_points_project_to_kornias_pixels_and_back():
    k = torch.tensor([[50.0, 0.5, 31.0], [0.0, 60.0, 22.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    cameras = pinhole_cameras(rig(CENTRES, turned(3)), k, width=64, height=48)
    geometry = ViewGeometry.of(cameras)
    points = 5 * torch.randn(40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    pixels, depths = geometry.project(points)
    expected = cameras.project(points[None].expand(3, -1, -1)).transpose(0, 1)
    front = depths > 0
    torch.testing.assert_close(pixels[front], expected[front])
    for view in range(3):
        back = geometry.unproject(pixels[:, view], depths[:, view], torch.full((40,), view))
        torch.testing.assert_close(back, points)
    assert torch.equal(project_points(points, cameras)[0], pixels)
    first = (pixels[:, 0], depths[:, 0], torch.zeros(40, dtype=torch.int64))
    assert torch.equal(unproject(*first, cameras), geometry.unproject(*first))


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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_scales_agree_with_scipy(dtype):
    points, colors = cloud(3000, dtype=dtype)
    points = points * torch.tensor([1.0, 10.0, 0.1], dtype=dtype) + 5.0
    distances, _ = cKDTree(points.double().numpy()).query(points.double().numpy(), k=4)
    expected = np.sqrt((distances[:, 1:] ** 2).mean(axis=1))
    scales = GaussianModel.from_points(points, colors)().scales
    assert scales.dtype == dtype
    assert np.allclose(scales.detach().numpy(), expected[:, None], rtol=1e-6)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_spacing_on_a_gpu_is_that_on_the_cpu():
    points, _ = cloud(501)
    spacing = log_spacing(points.cuda())
    assert spacing.device.type == "cuda"
    torch.testing.assert_close(spacing.cpu(), log_spacing(points), rtol=0, atol=1e-12)


@pytest.mark.parametrize("unit", [1e-15, 1e-3, 1e6, 1e15])
def test_scales_follow_the_unit_of_the_points(unit):
    points, _ = cloud()
    points[:10] = points[0]
    assert torch.allclose(log_spacing(points * unit), log_spacing(points) + math.log(unit), atol=1e-4)


def test_scales_do_not_depend_on_the_position_of_the_cloud():
    points, _ = cloud(dtype=torch.float64)
    shifted = points + torch.tensor([1e6, -2e6, 3e6], dtype=torch.float64)
    assert torch.allclose(log_spacing(shifted), log_spacing(points), atol=1e-6)


@pytest.mark.parametrize("copies", [4, 100, 190])
def test_coinciding_points_get_a_small_finite_scale(copies):
    points, _ = cloud()
    points[:copies] = points[0]
    scales = log_spacing(points).exp()
    assert bool(torch.isfinite(scales.log()).all())
    assert 1e-4 < scales[0] / scales[copies:].median() < 1e-2


@pytest.mark.parametrize("copies", [4, 5, 9])
def test_where_every_point_occurs_often_spacing_is_that_of_the_distinct_points(copies):
    points, _ = cloud()
    torch.testing.assert_close(log_spacing(points.repeat(copies, 1)), log_spacing(points).repeat(copies))


@pytest.mark.parametrize("count", [2, 3, 4])
def test_few_distinct_points_that_occur_often(count):
    corners = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 9.0]])[:count]
    distances = torch.cdist(corners, corners).square().sum(1) / min(3, count - 1)
    expected = 0.5 * distances.double().log()
    torch.testing.assert_close(log_spacing(corners.repeat(6, 1)), expected.repeat(6))


@pytest.mark.parametrize("mesh", [trimesh.creation.box(), trimesh.creation.icosphere(2), trimesh.creation.cone(1, 2)])
def test_corners_of_the_triangles_of_an_stl_have_sensible_scales(mesh):
    points = torch.from_numpy(mesh.triangles.reshape(-1, 3).copy()).float()
    scales = log_spacing(points).exp()
    edges = torch.from_numpy(mesh.edges_unique_length.copy())
    assert bool(torch.isfinite(scales).all())
    assert edges.min() / 2 < scales.min() <= scales.max() < 2 * edges.max()


@pytest.mark.parametrize("tiny", [0.0, 1e-300, 1e-200, 1e-160, 1e-90])
def test_almost_coinciding_points_have_finite_scales(tiny):
    points = torch.arange(12, dtype=torch.float64)[:, None].repeat(1, 3) * tiny
    for far in (1.0, 1e-3, 1e200):
        points[6:, 0] = far
        assert bool(torch.isfinite(log_spacing(points)).all())
