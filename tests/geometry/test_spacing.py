"""Distances between points: by SciPy, in closed form, and where points coincide."""

import math

import numpy as np
import pytest
import torch
from factories import random_cloud as cloud
from scipy.spatial import cKDTree

from kgs.geometry.spacing import log_spacing
from kgs.model import GaussianModel


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


@pytest.mark.parametrize("tiny", [0.0, 1e-300, 1e-200, 1e-160, 1e-90])
def test_almost_coinciding_points_have_finite_scales(tiny):
    points = torch.arange(12, dtype=torch.float64)[:, None].repeat(1, 3) * tiny
    for far in (1.0, 1e-3, 1e200):
        points[6:, 0] = far
        assert bool(torch.isfinite(log_spacing(points)).all())
