"""Nothing to project, and gradients of `project`."""

import pytest
import torch
from factories import posed, replace, whole_matrices
from kornia.geometry.camera import PinholeCamera
from kornia.sensors.camera import CameraModelType
from projection_checks import PACKED, scene, values_and_gradients

from kgs import project


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


def test_gradcheck_by_extrinsics_and_intrinsics_of_gaussians_beyond_the_limits_of_the_jacobian():
    """The limits follow the intrinsics."""
    gaussians, cameras = scene(3, 1, cameras=2)
    means = gaussians.means * torch.tensor([0.5, 0.5, 1.0], dtype=torch.float64)
    means += torch.tensor([[-7.0, 0, 0], [0, 4.5, 0], [6.0, -5.0, 0]], dtype=torch.float64)
    gaussians = replace(gaussians, means=means, scales=gaussians.scales * 20)
    cameras.intrinsics[:, 0, 1] = 2.0
    tangents = means[:, :2] / means[:, 2:]
    assert (tangents.abs() > 1.3 * 32 / cameras.intrinsics[0, 0, 0]).any(1).all()
    assert len(project(gaussians, cameras)) == 6
    leaves = [cameras.extrinsics.clone().requires_grad_(), cameras.intrinsics[:, :2, :3].clone().requires_grad_()]

    def run(extrinsics, intrinsics):
        return packed(gaussians, PinholeCamera(whole_matrices(intrinsics), extrinsics, cameras.height, cameras.width))

    assert torch.autograd.gradcheck(run, leaves, atol=1e-6)
