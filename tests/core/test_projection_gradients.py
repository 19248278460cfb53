"""Nothing to project, and gradients of `project`."""

import pytest
import torch
from factories import FIELDS, posed, replace, whole_matrices
from kornia.geometry.camera import PinholeCamera
from kornia.sensors.camera import CameraModelType
from projection_checks import PACKED, scene, values_and_gradients

from kgs import Gaussians, project


@pytest.mark.parametrize("kind", list(CameraModelType))
def test_other_camera_models_with_nothing_visible_or_no_gradient_asked_for(kind):
    gaussians, cameras = scene(5)
    camera = posed(kind, extrinsics=cameras.extrinsics)
    seen = project(gaussians, camera)
    assert len(seen) > 0
    assert not any(getattr(seen, name).requires_grad for name in PACKED)
    got, grads = values_and_gradients(replace(gaussians, means=-gaussians.means), camera)
    assert len(got) == 0
    assert all((grad == 0).all() for grad in grads.values())


def packed(gaussians, cameras):
    """All outputs in one vector: gradcheck would skip an output that lost its graph."""
    got = project(gaussians, cameras)
    fields = (got.means2d, got.conics, got.depths, got.opacities, got.colors)
    return torch.cat([field.flatten() for field in fields])


@pytest.mark.parametrize("degree", [None, 1])
def test_gradcheck_with_respect_to_the_gaussians(degree):
    gaussians, cameras = scene(2, degree, cameras=2)
    leaves = [getattr(gaussians, name).requires_grad_() for name in FIELDS]
    assert len(project(gaussians, cameras)) == 3, "one of the pairs is not visible"
    assert torch.autograd.gradcheck(lambda *values: packed(Gaussians(*values), cameras), leaves, atol=1e-6)


def inner(gaussians):
    return replace(gaussians, means=gaussians.means * torch.tensor([0.5, 0.5, 1.0], dtype=torch.float64))


@pytest.mark.parametrize("beyond", [0, 3])
def test_gradcheck_with_respect_to_extrinsics_and_intrinsics(beyond):
    """Also of Gaussians beyond the limits of the Jacobian, which follow the intrinsics."""
    gaussians, cameras = scene(3, 1, cameras=2)
    means = inner(gaussians).means
    means[:beyond] += torch.tensor([[-7.0, 0, 0], [0, 4.5, 0], [6.0, -5.0, 0]], dtype=torch.float64)[:beyond]
    gaussians = replace(gaussians, means=means, scales=gaussians.scales * (20 if beyond else 1))
    cameras.intrinsics[:, 0, 1] = 2.0
    tangents = means[:, :2] / means[:, 2:]
    assert ((tangents.abs() > 1.3 * 32 / cameras.intrinsics[0, 0, 0]).any(1)).sum() == beyond
    assert len(project(gaussians, cameras)) == 6
    leaves = [cameras.extrinsics.clone().requires_grad_(), cameras.intrinsics[:, :2, :3].clone().requires_grad_()]

    def run(extrinsics, intrinsics):
        return packed(gaussians, PinholeCamera(whole_matrices(intrinsics), extrinsics, cameras.height, cameras.width))

    assert torch.autograd.gradcheck(run, leaves, atol=1e-6)
