"""Batches, memory layouts and gradients of `project`."""

import pytest
import torch
from factories import FIELDS, random_camera, random_gaussians, replace, whole_matrices
from kornia.geometry.camera import PinholeCamera
from kornia.sensors.camera import CameraModelType
from projection_checks import HEIGHT, LENGTHS, PACKED, WIDTH, assert_same, posed, scene, values_and_gradients

from kgs import Gaussians, RasterOptions, project

# -- batches -------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("each_backend")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_of_cameras_is_its_cameras_one_by_one(dtype):
    gaussians, cameras = scene(cameras=3, dtype=dtype)
    together = project(gaussians, cameras)
    singles = [project(gaussians, random_camera(HEIGHT, WIDTH, seed, dtype)) for seed in range(3)]
    for name in ("gaussian_ids", *PACKED):
        assert torch.equal(getattr(together, name), torch.cat([getattr(single, name) for single in singles]))
    assert together.camera_ids.bincount().tolist() == [len(single) for single in singles]
    assert (together.num_cameras, together.num_gaussians) == (3, 60)


def test_opacities_of_each_camera():
    gaussians, cameras = scene(cameras=3)
    opacities = torch.stack([gaussians.opacities, gaussians.opacities / 2, gaussians.opacities * 1.2])
    together = project(replace(gaussians, opacities=opacities), cameras)
    assert torch.equal(together.opacities, opacities[together.camera_ids, together.gaussian_ids])
    for wrong in (opacities[:2], opacities[:1]):
        with pytest.raises(ValueError, match="^opacities:"):
            project(replace(gaussians, opacities=wrong), cameras)


@pytest.mark.usefixtures("each_backend")
def test_memory_layout_of_the_inputs_does_not_matter():
    gaussians, cameras = scene(dtype=torch.float32)
    strided = Gaussians(*(torch.stack([x, x], -1)[..., 0] for x in (getattr(gaussians, name) for name in FIELDS)))
    assert not strided.means.is_contiguous()
    assert_same(project(gaussians, cameras), project(strided, cameras))


@pytest.mark.parametrize("degree", [None, 0, 3])
def test_nothing_visible_gives_empty_fields_and_zero_gradients(degree):
    gaussians = random_gaussians(5, 0, sh_degree=degree)
    got, grads = values_and_gradients(replace(gaussians, means=-gaussians.means), random_camera(HEIGHT, WIDTH, 0))
    assert len(got) == 0
    shapes = [tuple(getattr(got, name).shape) for name in ("camera_ids", "gaussian_ids", *PACKED)]
    assert shapes == [(0,), (0,), (0, 2), (0, 2, 3), (0,), (0,), (0,), (0, 3)]
    assert got.conics.shape == (0, 3)
    assert all((grad == 0).all() for grad in grads.values())


@pytest.mark.parametrize("kind", list(CameraModelType))
def test_other_camera_models_with_nothing_visible_or_no_gradient_asked_for(kind):
    gaussians, cameras = scene(5)
    params = torch.tensor([60.0, 60, 31, 24, *[0.01] * LENGTHS[kind]], dtype=torch.float64)
    camera = posed(kind, params, cameras.extrinsics)
    seen = project(gaussians, camera)
    assert len(seen) > 0
    assert not any(getattr(seen, name).requires_grad for name in PACKED)
    got, grads = values_and_gradients(replace(gaussians, means=-gaussians.means), camera)
    assert len(got) == 0
    assert all((grad == 0).all() for grad in grads.values())


@pytest.mark.parametrize("degree", [None, 2])
@pytest.mark.parametrize("opacity_rows", [None, 3])
def test_no_gaussians_at_all(opacity_rows, degree):
    gaussians, cameras = scene(0, degree, cameras=3)
    if opacity_rows:
        gaussians = replace(gaussians, opacities=torch.zeros(opacity_rows, 0, dtype=torch.float64))
    got = project(gaussians, cameras)
    assert (len(got), got.num_cameras, got.num_gaussians, got.num_nonfinite.item()) == (0, 3, 0, 0)


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e6])
def test_the_unit_of_length_does_not_matter(unit):
    gaussians, cameras = scene(degree=2)
    scaled = replace(gaussians, means=gaussians.means * unit, scales=gaussians.scales * unit)
    extrinsics = cameras.extrinsics.clone()
    extrinsics[:, :3, 3] *= unit
    first = project(gaussians, cameras)
    moved = PinholeCamera(cameras.intrinsics, extrinsics, cameras.height, cameras.width)
    second = project(scaled, moved, options=RasterOptions(near_plane=0.01 * unit))
    assert torch.equal(first.gaussian_ids, second.gaussian_ids)
    torch.testing.assert_close(first.depths, second.depths / unit, rtol=1e-12, atol=1e-12)
    for name in ("means2d", "factors", "radii", "opacities", "colors"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=1e-11, atol=1e-11)


def packed(gaussians, cameras):
    """All outputs in one vector: gradcheck would skip an output that lost its graph."""
    got = project(gaussians, cameras)
    fields = (got.means2d, got.conics, got.depths, got.opacities, got.colors)
    return torch.cat([field.flatten() for field in fields])


# -- gradients -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [None, 0, 3])
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
    gaussians, cameras = scene(3, 2, cameras=2)
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


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(CameraModelType.BROWN_CONRADY, marks=pytest.mark.slow),
        CameraModelType.KANNALA_BRANDT_K3,
        CameraModelType.ORTHOGRAPHIC,
    ],
)
def test_gradcheck_through_other_camera_models(kind):
    gaussians, cameras = scene(2, 1)
    focal = 8.0 if kind is CameraModelType.ORTHOGRAPHIC else 60.0
    params = torch.tensor([focal, focal, 31, 24, *[0.01] * LENGTHS[kind]], dtype=torch.float64, requires_grad=True)
    gaussians = inner(gaussians)
    leaves = [getattr(gaussians, name).requires_grad_() for name in FIELDS]

    def run(params, extrinsics, *values):
        return packed(Gaussians(*values), posed(kind, params, extrinsics))

    assert torch.autograd.gradcheck(run, (params, cameras.extrinsics.clone().requires_grad_(), *leaves), atol=1e-6)


def test_translating_the_world_and_the_camera_together_changes_nothing_so_their_gradients_cancel():
    gaussians, cameras = scene(degree=3)
    means, extrinsics = gaussians.means.requires_grad_(), cameras.extrinsics.clone().requires_grad_()
    values = packed(
        replace(gaussians, means=means), PinholeCamera(cameras.intrinsics, extrinsics, cameras.height, cameras.width)
    )
    (values * torch.linspace(-1, 1, len(values), dtype=values.dtype)).sum().backward()
    rotation = cameras.extrinsics[0, :3, :3]
    torch.testing.assert_close(means.grad.sum(0), rotation.T @ extrinsics.grad[0, :3, 3], rtol=1e-9, atol=1e-9)
