"""`project` against the covariance route in float64 and against OpenCV."""

import math

import cv2
import mpmath
import numpy as np
import pytest
import torch
from factories import pinhole, posed, random_camera, random_gaussians, replace, whole_matrices
from kornia.geometry.camera import PinholeCamera
from kornia.sensors.camera import CameraModelType
from oracles import real_harmonic
from projection_checks import HEIGHT, PACKED, WIDTH, covariances, scene, sigma_route, values_and_gradients

from kgs import Gaussians, RasterOptions, project

pytestmark = pytest.mark.usefixtures("each_backend")


def symmetric(abc):
    return abc[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-11), (torch.float32, 2e-5)])
@pytest.mark.parametrize("skew", [0.0, 4.0])
@pytest.mark.parametrize("eps2d", [0.3, 0.0])
def test_values_are_those_of_the_covariance_route(dtype, tolerance, skew, eps2d):
    gaussians, cameras = scene(dtype=dtype)
    cameras.intrinsics[:, 0, 1] = skew
    got = project(gaussians, cameras, options=RasterOptions(eps2d=eps2d))
    pixels, sigma, depths = (x.index_select(0, got.gaussian_ids) for x in sigma_route(gaussians, cameras, eps2d))
    assert len(got) > 40
    assert all(getattr(got, name).dtype == dtype for name in PACKED)
    torch.testing.assert_close(got.means2d.double(), pixels, rtol=tolerance, atol=10 * tolerance)
    torch.testing.assert_close(got.depths.double(), depths, rtol=tolerance, atol=0)
    factors = got.factors.double()
    dilated = factors @ factors.mT + eps2d * torch.eye(2, dtype=torch.float64)
    torch.testing.assert_close(dilated, sigma, rtol=10 * tolerance, atol=10 * tolerance)
    identity = symmetric(got.conics.double()) @ sigma
    torch.testing.assert_close(
        identity, torch.eye(2, dtype=torch.float64).expand_as(sigma), rtol=0, atol=50 * tolerance
    )
    radii = 3 * torch.linalg.eigvalsh(sigma)[:, 1].sqrt()
    assert torch.equal(got.radii, got.radii.round())
    assert ((got.radii.double() >= radii - 1e-3) & (got.radii.double() < radii + 1 + 1e-3)).all()
    torch.testing.assert_close(got.opacities, gaussians.opacities.index_select(0, got.gaussian_ids), rtol=0, atol=0)


def test_the_pinhole_model_is_the_pinhole_camera():
    gaussians, cameras = scene(degree=2, cameras=2)
    k = cameras.intrinsics
    params = torch.stack([k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2]], 1)
    first, second = (
        project(gaussians, cameras),
        project(gaussians, posed(CameraModelType.PINHOLE, params, extrinsics=cameras.extrinsics)),
    )
    assert torch.equal(first.camera_ids, second.camera_ids)
    assert torch.equal(first.gaussian_ids, second.gaussian_ids)
    for name in PACKED:
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("kind", [CameraModelType.BROWN_CONRADY, CameraModelType.KANNALA_BRANDT_K3])
def test_convention_distorted_means_and_covariances_are_opencvs(kind):
    gaussians, cameras = scene()
    distortion = [0.05, -0.02, 0.003, -0.002] + (
        [0.01, 0.02, 0.01, 0.01] if kind is CameraModelType.BROWN_CONRADY else []
    )
    params = torch.tensor([60.0, 62, 31, 24, *distortion], dtype=torch.float64)
    got = project(gaussians, posed(kind, params, extrinsics=cameras.extrinsics))
    pose = cameras.extrinsics[0]
    at = (gaussians.means @ pose[:3, :3].T + pose[:3, 3])[got.gaussian_ids].numpy()
    k, zero = np.array([[60.0, 0, 31], [0, 62, 24], [0, 0, 1]]), np.zeros(3)
    if kind is CameraModelType.BROWN_CONRADY:
        pixels, jacobian = cv2.projectPoints(at, zero, zero, k, np.array(distortion))
        jacobian = jacobian[:, 3:6]
    else:
        pixels, jacobian = cv2.fisheye.projectPoints(at[None], zero, zero, k, np.array(distortion))
        jacobian = jacobian[:, 11:14]
    torch.testing.assert_close(got.means2d, torch.from_numpy(pixels.reshape(-1, 2)), rtol=0, atol=1e-9)
    inside = (np.abs(at[:, :2] / at[:, 2:]) < [0.5, 0.4]).all(1)
    rows = torch.from_numpy(jacobian).reshape(-1, 2, 3) @ pose[:3, :3]
    sigma = rows @ covariances(gaussians)[got.gaussian_ids] @ rows.mT
    assert inside.sum() > 30
    torch.testing.assert_close((got.factors @ got.factors.mT)[inside], sigma[inside], rtol=1e-7, atol=1e-7)


def test_orthographic_footprints_are_exact_marginals_and_all_rays_share_the_colour_direction():
    gaussians, cameras = scene(degree=1)
    params = torch.tensor([8.0, 9, 31, 24], dtype=torch.float64)
    gaussians = replace(gaussians, colors=gaussians.colors[:1].repeat(len(gaussians), 1, 1))
    got = project(gaussians, posed(CameraModelType.ORTHOGRAPHIC, params, extrinsics=cameras.extrinsics))
    pose, zoom = cameras.extrinsics[0], torch.diag(params[:2])
    at = (gaussians.means @ pose[:3, :3].T + pose[:3, 3])[got.gaussian_ids]
    torch.testing.assert_close(got.means2d, at[:, :2] @ zoom + params[2:])
    torch.testing.assert_close(got.depths, at[:, 2])
    sigma = (pose[:3, :3] @ covariances(gaussians) @ pose[:3, :3].T)[got.gaussian_ids, :2, :2]
    torch.testing.assert_close(got.factors @ got.factors.mT, zoom @ sigma @ zoom)
    assert got.colors.std(0).max() < 1e-14
    x, y, z = torch.linalg.inv(pose)[:3, 2].tolist()
    basis = [float(real_harmonic(k, mpmath.acos(z), mpmath.atan2(y, x))) for k in range(4)]
    expected = (torch.tensor(basis, dtype=torch.float64) @ gaussians.colors[0] + 0.5).clamp_min(0)
    torch.testing.assert_close(got.colors[0], expected)


# -- gradients -------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("torch_alone")
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


@pytest.mark.usefixtures("torch_alone")
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


# -- listed ----------------------------------------------------------------------------------------------------------


def wide_scene(dtype=torch.float64):
    """Gaussians in, partly in and far outside the image, before and behind the camera, faint and dense."""
    gaussians = random_gaussians(600, 3, dtype, 0, WIDTH, opacities=(0.0, 1.0))
    means = gaussians.means * torch.tensor([3.0, 3.0, 1.0], dtype=dtype)
    means[::5, 2] *= -1
    return replace(gaussians, means=means)


REACH = math.sqrt(2 * math.log(2 * 255))  # standard deviations within which a footprint of opacity 2 is drawn


def test_the_list_is_everything_in_front_that_would_be_drawn_at_opacity_two():
    gaussians, cameras = wide_scene(), random_camera(HEIGHT, WIDTH, 0)
    got = project(gaussians, cameras)
    pixels, sigma, depths = sigma_route(gaussians, cameras)
    reach = REACH * sigma.diagonal(dim1=1, dim2=2).sqrt()
    size = torch.tensor([WIDTH, HEIGHT], dtype=torch.float64)
    distance = (torch.maximum(-0.5 - pixels, pixels - size + 0.5) - reach).amax(1)  # below 0: the image is touched
    clear = distance.abs() > 0.05
    expected = (distance < 0) & (depths > 0.01)
    listed = torch.zeros(len(gaussians), dtype=torch.bool)
    listed[got.gaussian_ids] = True
    assert torch.equal(listed[clear], expected[clear])
    assert 50 < len(got) < 400
    assert clear.sum() > 580


def test_with_threshold_0_every_gaussian_in_front_is_listed():
    gaussians, cameras = wide_scene(), random_camera(HEIGHT, WIDTH, 0)
    depths = sigma_route(gaussians, cameras)[2]
    listed = project(gaussians, cameras, options=RasterOptions(alpha_threshold=0.0)).gaussian_ids
    assert torch.equal(listed, (depths > 0.01).nonzero()[:, 0])


@pytest.mark.parametrize(("beyond", "listed"), [(3.2, [True] * 5), (3.5, [True] * 5), (3.6, [False] * 4 + [True])])
def test_visibility_is_free_of_opacity(beyond, listed):
    """A dot of variance 1 beside the image: the same for every opacity up to 2; above, the list only grows."""
    mean = torch.tensor([[0.0, 0.0, 4.0]], dtype=torch.float64)
    one = Gaussians(mean, torch.eye(4)[:1].double(), torch.full((1, 3), 1e-9).double(), torch.ones(1).double(), mean)
    camera = pinhole(HEIGHT, WIDTH, 4.0, centre=(-0.5 - beyond, 24.0))
    seen = [
        len(project(replace(one, opacities=torch.tensor([opacity]).double()), camera, options=RasterOptions(eps2d=1.0)))
        == 1
        for opacity in (0.0, 0.2, 1.0, 1.25, 4.0)
    ]
    assert seen == listed
