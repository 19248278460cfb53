"""`project` against the covariance route in float64, against OpenCV, and against its own contract of what is listed."""

import math

import cv2
import mpmath
import numpy as np
import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType
from oracles import pinhole, random_camera, random_gaussians, real_harmonic

import kgs
from kgs import DropGaussian, Gaussians, PosedCamera, project

HEIGHT, WIDTH = 48, 64
FIELDS = ("means", "quats", "scales", "opacities", "colors")
LENGTHS = {kind: 0 for kind in CameraModelType} | {  # of the distortion
    CameraModelType.BROWN_CONRADY: 8,
    CameraModelType.KANNALA_BRANDT_K3: 4,
}
PACKED = ("means2d", "factors", "depths", "radii", "opacities", "colors")


def replace(gaussians, **changes):
    return Gaussians(**{name: getattr(gaussians, name) for name in FIELDS} | changes)


def select(gaussians, ids):
    return Gaussians(
        *(
            getattr(gaussians, name)[..., ids] if name == "opacities" else getattr(gaussians, name)[ids]
            for name in FIELDS
        )
    )


def join(*parts):
    return Gaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in FIELDS))


def batch(*cameras):
    return PinholeCamera(
        *(torch.cat([getattr(c, name) for c in cameras]) for name in ("intrinsics", "extrinsics", "height", "width"))
    )


def scene(n=60, degree=1, dtype=torch.float64, cameras=1):
    views = [random_camera(HEIGHT, WIDTH, seed, dtype) for seed in range(cameras)]
    return random_gaussians(n, 0, dtype, degree, WIDTH), batch(*views)


def posed(kind, params, extrinsics):
    return PosedCamera(CameraModel(ImageSize(HEIGHT, WIDTH), kind, params), extrinsics)


def assert_same(first, second):
    """Bitwise the same list, Gaussian numbers aside."""
    for name in ("camera_ids", *PACKED):
        assert torch.equal(getattr(first, name), getattr(second, name)), name


def covariances(gaussians):
    """R S S R^T in float64 with R v = q v q* / |q|^2."""
    w, x, y, z = gaussians.quats.double().unbind(1)
    turn = (
        torch.stack(
            [
                *(w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
                *(2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
                *(2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
            ],
            1,
        ).reshape(-1, 3, 3)
        / (w * w + x * x + y * y + z * z)[:, None, None]
    )
    return turn @ torch.diag_embed(gaussians.scales.double() ** 2) @ turn.mT


def sigma_route(gaussians, camera, eps2d=0.3):
    """All Gaussians of one pinhole camera in float64: means2d, covariances J W Sigma W^T J^T + eps I, depths."""
    k, pose = camera.intrinsics[0, :3, :3].double(), camera.extrinsics[0].double()
    at = gaussians.means.double() @ pose[:3, :3].T + pose[:3, 3]
    z = at[:, 2:]
    pixels = (at @ k.T)[:, :2] / z
    size = torch.tensor([WIDTH, HEIGHT], dtype=torch.float64)
    focal, centre = k.diagonal()[:2], k[:2, 2]
    tangents = ((focal * at[:, :2] / z + centre).clamp(-0.5 - 0.15 * size, 1.15 * size - 0.5) - centre) / focal
    eye = torch.eye(2, dtype=torch.float64)
    jacobian = k[:2, :2] @ torch.cat([eye.expand(len(z), 2, 2), -tangents[:, :, None]], 2) / z[:, :, None]
    rows = jacobian @ pose[:3, :3]
    return pixels, rows @ covariances(gaussians) @ rows.mT + eps2d * eye, at[:, 2]


def symmetric(abc):
    return abc[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


# -- values --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-11), (torch.float32, 2e-5)])
@pytest.mark.parametrize("skew", [0.0, 4.0])
@pytest.mark.parametrize("eps2d", [0.3, 0.0])
def test_values_are_those_of_the_covariance_route(dtype, tolerance, skew, eps2d):
    gaussians, cameras = scene(dtype=dtype)
    cameras.intrinsics[:, 0, 1] = skew
    got = project(gaussians, cameras, eps2d=eps2d)
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


def test_one_isotropic_gaussian_on_the_axis_by_hand():
    one = Gaussians(
        *(torch.tensor(v) for v in ([[0.0, 0, 4]], [[2.0, 0, 0, 0]], [[0.1] * 3], [0.5], [[0.2, 0.4, 0.6]]))
    )
    got = project(one, pinhole(HEIGHT, WIDTH, 80.0, dtype=torch.float32))
    variance = (80 * 0.1 / 4) ** 2 + 0.3
    assert got.means2d.tolist() == [[(WIDTH - 1) / 2, (HEIGHT - 1) / 2]]
    assert got.conics.tolist() == [pytest.approx([1 / variance, 0, 1 / variance], rel=1e-6)]
    assert (got.depths.tolist(), got.radii.tolist()) == ([4.0], [7.0])
    assert torch.equal(got.colors, one.colors)
    assert (got.image_size, got.num_cameras, got.num_gaussians, got.eps2d) == ((HEIGHT, WIDTH), 1, 1, 0.3)
    assert got.num_nonfinite.item() == 0
    assert got.num_nonfinite.ndim == 0


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_are_harmonics_of_the_direction_from_the_camera(degree):
    gaussians, cameras = scene(12, degree)
    got = project(gaussians, cameras)
    centre = torch.linalg.inv(cameras.extrinsics[0])[:3, 3]
    for i, color in zip(got.gaussian_ids.tolist(), got.colors, strict=True):
        x, y, z = (gaussians.means[i] - centre).tolist()
        polar, azimuth = mpmath.acos(z / mpmath.sqrt(x * x + y * y + z * z)), mpmath.atan2(y, x)
        basis = [float(real_harmonic(k, polar, azimuth)) for k in range((degree + 1) ** 2)]
        expected = (torch.tensor(basis, dtype=torch.float64) @ gaussians.colors[i] + 0.5).clamp_min(0)
        torch.testing.assert_close(color, expected, rtol=1e-12, atol=1e-12)


def test_rgb_is_passed_on_and_colours_are_left_out_when_not_wanted():
    gaussians = random_gaussians(20, 0, sh_degree=None)
    gaussians = replace(gaussians, colors=10 * gaussians.colors - 5)
    got = project(gaussians, random_camera(HEIGHT, WIDTH, 0))
    assert torch.equal(got.colors, gaussians.colors[got.gaussian_ids]), "neither shifted nor clamped"
    without = project(gaussians, random_camera(HEIGHT, WIDTH, 0), colors=False)
    assert without.colors.shape == (len(got), 0)
    assert torch.equal(without.means2d, got.means2d)


# -- other camera models -------------------------------------------------------------------------------------------


def test_the_pinhole_model_is_the_pinhole_camera():
    gaussians, cameras = scene(degree=2, cameras=2)
    k = cameras.intrinsics
    params = torch.stack([k[:, 0, 0], k[:, 1, 1], k[:, 0, 2], k[:, 1, 2]], 1)
    first, second = (
        project(gaussians, cameras),
        project(gaussians, posed(CameraModelType.PINHOLE, params, cameras.extrinsics)),
    )
    assert torch.equal(first.camera_ids, second.camera_ids)
    assert torch.equal(first.gaussian_ids, second.gaussian_ids)
    for name in PACKED:
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("kind", [CameraModelType.BROWN_CONRADY, CameraModelType.KANNALA_BRANDT_K3])
def test_distorted_means_and_covariances_are_opencvs(kind):
    gaussians, cameras = scene()
    distortion = [0.05, -0.02, 0.003, -0.002] + (
        [0.01, 0.02, 0.01, 0.01] if kind is CameraModelType.BROWN_CONRADY else []
    )
    params = torch.tensor([60.0, 62, 31, 24, *distortion], dtype=torch.float64)
    got = project(gaussians, posed(kind, params, cameras.extrinsics))
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
    got = project(gaussians, posed(CameraModelType.ORTHOGRAPHIC, params, cameras.extrinsics))
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


# -- what is listed ------------------------------------------------------------------------------------------------


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


def test_footprints_count_to_the_outer_edge_of_the_border_pixels():
    reach = REACH * math.sqrt(0.3) + 0.5
    places = []
    for off in (-0.01, 0.01):
        far = reach + off
        places += [(-far, 20), (WIDTH - 1 + far, 20), (30, -far), (30, HEIGHT - 1 + far)]
    camera = pinhole(HEIGHT, WIDTH, 1.0, (0.0, 0.0))
    means = torch.cat([torch.tensor(places), torch.ones(8, 1)], 1).double()
    quats, scales = torch.eye(4)[:1].expand(8, 4).double(), torch.full((8, 3), 1e-9).double()
    got = project(Gaussians(means, quats, scales, torch.full((8,), 0.5).double(), means), camera)
    assert got.gaussian_ids.tolist() == [0, 1, 2, 3]
    assert got.radii.tolist() == [2.0] * 4


def test_nothing_that_could_be_drawn_is_left_out():
    gaussians, cameras = wide_scene(), random_camera(HEIGHT, WIDTH, 0)
    listed = torch.zeros(len(gaussians), dtype=torch.bool)
    listed[project(gaussians, cameras).gaussian_ids] = True
    pixels, sigma, depths = sigma_route(gaussians, cameras)
    y, x = torch.meshgrid(torch.arange(HEIGHT).double(), torch.arange(WIDTH).double(), indexing="ij")
    d = torch.stack([x.flatten(), y.flatten()], 1)[None] - pixels[:, None]
    alphas = gaussians.opacities[:, None] * torch.exp(-0.5 * ((d @ torch.linalg.inv(sigma)) * d).sum(2))
    drawn = (alphas.amax(1) >= 1 / 255) & (depths > 0.01)
    assert drawn.sum() > 40
    assert listed[drawn].all()


def test_the_list_is_ordered_by_camera_and_then_by_gaussian():
    gaussians, cameras = scene(cameras=3)
    got = project(gaussians, cameras)
    key = got.camera_ids * len(gaussians) + got.gaussian_ids
    assert (key.diff() > 0).all()
    assert got.camera_ids.unique().tolist() == [0, 1, 2]
    assert got.camera_ids.dtype == got.gaussian_ids.dtype == torch.int64


@pytest.mark.parametrize("threshold", [1 / 255, 0.0])
def test_dropped_gaussians_stay_listed_and_only_the_opacities_tell_them(threshold):
    gaussians, cameras = wide_scene(), random_camera(HEIGHT, WIDTH, 0)
    opacities = DropGaussian(p=0.45, schedule="constant", seed=0)(gaussians.opacities)
    assert opacities.max() > 1
    full = project(gaussians, cameras, alpha_threshold=threshold)
    dropped = project(replace(gaussians, opacities=opacities), cameras, alpha_threshold=threshold)
    assert (dropped.opacities == 0).sum() > 20
    for name in ("camera_ids", "gaussian_ids", "means2d", "factors", "depths", "radii", "colors"):
        assert torch.equal(getattr(full, name), getattr(dropped, name))


def test_with_threshold_0_every_gaussian_in_front_is_listed():
    gaussians, cameras = wide_scene(), random_camera(HEIGHT, WIDTH, 0)
    depths = sigma_route(gaussians, cameras)[2]
    listed = project(gaussians, cameras, alpha_threshold=0.0).gaussian_ids
    assert torch.equal(listed, (depths > 0.01).nonzero()[:, 0])


@pytest.mark.parametrize(("beyond", "listed"), [(3.2, [True] * 5), (3.5, [True] * 5), (3.6, [False] * 4 + [True])])
def test_visibility_is_free_of_opacity(beyond, listed):
    """A dot of variance 1 beside the image: the same for every opacity up to 2; above, the list only grows."""
    mean = torch.tensor([[0.0, 0.0, 4.0]], dtype=torch.float64)
    one = Gaussians(mean, torch.eye(4)[:1].double(), torch.full((1, 3), 1e-9).double(), torch.ones(1).double(), mean)
    camera = pinhole(HEIGHT, WIDTH, 4.0, centre=(-0.5 - beyond, 24.0))
    seen = [
        len(project(replace(one, opacities=torch.tensor([opacity]).double()), camera, eps2d=1.0)) == 1
        for opacity in (0.0, 0.2, 1.0, 1.25, 4.0)
    ]
    assert seen == listed


@pytest.mark.parametrize("near", [0.01, 0.2, 1.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_near_plane_is_exclusive_and_nothing_behind_it_has_a_gradient(near, dtype):
    plane = torch.tensor(near, dtype=dtype).item()
    above = torch.nextafter(torch.tensor(near, dtype=dtype), torch.tensor(torch.inf, dtype=dtype)).item()
    base = random_gaussians(1, 0, dtype, 1)
    for z in (-5.0, -1e-30, 0.0, plane, above):
        mean = torch.tensor([[0.0, 0.0, z]], dtype=dtype)
        leaves = {name: getattr(base, name).clone().requires_grad_() for name in FIELDS} | {
            "means": mean.requires_grad_()
        }
        got = project(Gaussians(**leaves), pinhole(HEIGHT, WIDTH, 50.0, dtype=dtype), near_plane=plane)
        assert len(got) == int(z == above)
        sum(getattr(got, name).sum() for name in PACKED).backward()
        for leaf in leaves.values():
            assert leaf.grad.isfinite().all()
            assert len(got) or (leaf.grad == 0).all()


def test_a_thousand_gaussians_behind_the_camera_change_nothing():
    gaussians, cameras = scene(dtype=torch.float32)
    behind = random_gaussians(1000, 9, torch.float32, 1)
    behind = replace(behind, means=-behind.means)
    first = project(gaussians, cameras)
    for joined, shift in ((join(gaussians, behind), 0), (join(behind, gaussians), 1000)):
        second = project(joined, cameras)
        assert_same(first, second)
        assert torch.equal(second.gaussian_ids, first.gaussian_ids + shift)


# -- parameters that are not finite --------------------------------------------------------------------------------


def values_and_gradients(gaussians, cameras):
    leaves = {name: getattr(gaussians, name).clone().requires_grad_() for name in FIELDS}
    got = project(Gaussians(**leaves), cameras)
    (
        got.means2d.sum() + got.factors.square().sum() + got.depths.sum() + (got.opacities[:, None] * got.colors).sum()
    ).backward()
    return got, {name: leaf.grad for name, leaf in leaves.items()}


@pytest.mark.parametrize("poison", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("name", FIELDS)
def test_a_gaussian_that_is_not_finite_is_left_out_counted_and_harms_no_other(name, poison):
    gaussians, cameras = scene(40, dtype=torch.float32)
    victim = 7
    others = torch.arange(40) != victim
    expected, expected_grads = values_and_gradients(select(gaussians, others), cameras)
    values = getattr(gaussians, name).clone()
    values[victim].view(-1)[-1] = poison
    got, grads = values_and_gradients(replace(gaussians, **{name: values}), cameras)
    assert got.num_nonfinite.item() == 1
    assert expected.num_nonfinite.item() == 0
    assert victim not in got.gaussian_ids.tolist()
    assert_same(got, expected)
    for field in FIELDS:
        assert torch.equal(grads[field][others], expected_grads[field])
        assert (grads[field][victim] == 0).all()


def test_infinities_of_both_signs_do_not_cancel_and_large_finite_values_do_not_count():
    gaussians, cameras = scene(10, dtype=torch.float32)
    colors = gaussians.colors.clone()
    colors[2, 0], colors[3, 0, 0], colors[3, 1, 1] = 3e38, torch.inf, -torch.inf
    got = project(replace(gaussians, colors=colors), cameras)
    assert got.num_nonfinite.item() == 1
    assert 2 in got.gaussian_ids.tolist()
    assert 3 not in got.gaussian_ids.tolist()


def test_an_opacity_that_is_not_finite_for_one_camera_counts_once():
    gaussians, cameras = scene(10, cameras=3)
    opacities = gaussians.opacities.repeat(3, 1)
    opacities[1, 4] = torch.nan
    got = project(replace(gaussians, opacities=opacities), cameras)
    assert got.num_nonfinite.item() == 1
    assert 4 not in got.gaussian_ids.tolist()


@pytest.mark.parametrize("log_scale", [-100.0, 44.0, 60.0, 88.0])
def test_finite_scales_of_any_size_give_finite_values_and_gradients_and_harm_no_other(log_scale):
    gaussians, cameras = scene(40, dtype=torch.float32)
    victim = 7
    others = torch.arange(40) != victim
    expected, expected_grads = values_and_gradients(select(gaussians, others), cameras)
    scales = gaussians.scales.clone()
    scales[victim, 2] = math.exp(log_scale)
    got, grads = values_and_gradients(replace(gaussians, scales=scales), cameras)
    assert got.num_nonfinite.item() == 0
    rest = got.gaussian_ids != victim
    for name in PACKED:
        assert torch.equal(getattr(got, name)[rest], getattr(expected, name))
        assert getattr(got, name).isfinite().all()
    for field in FIELDS:
        torch.testing.assert_close(grads[field][others], expected_grads[field], rtol=1e-6, atol=0)
        assert grads[field].isfinite().all()


# -- batches -------------------------------------------------------------------------------------------------------


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
        with pytest.raises(ValueError, match=r"opacities: expected shape \(60,\) or \(3, 60\) for 3 cameras, got"):
            project(replace(gaussians, opacities=wrong), cameras)


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
    second = project(scaled, moved, near_plane=0.01 * unit)
    assert torch.equal(first.gaussian_ids, second.gaussian_ids)
    torch.testing.assert_close(first.depths, second.depths / unit, rtol=1e-12, atol=1e-12)
    for name in ("means2d", "factors", "radii", "opacities", "colors"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=1e-11, atol=1e-11)


# -- gradients -----------------------------------------------------------------------------------------------------


def packed(gaussians, cameras):
    """All outputs in one vector: gradcheck would skip an output that lost its graph."""
    got = project(gaussians, cameras)
    fields = (got.means2d, got.conics, got.depths, got.opacities, got.colors)
    return torch.cat([field.flatten() for field in fields])


@pytest.mark.parametrize("degree", [None, 0, 3])
def test_gradcheck_with_respect_to_the_gaussians(degree):
    gaussians, cameras = scene(2, degree, cameras=2)
    leaves = [getattr(gaussians, name).requires_grad_() for name in FIELDS]
    assert len(project(gaussians, cameras)) == 3, "one of the pairs is not visible"
    assert torch.autograd.gradcheck(lambda *values: packed(Gaussians(*values), cameras), leaves, atol=1e-6)


def inner(gaussians):
    return replace(gaussians, means=gaussians.means * torch.tensor([0.5, 0.5, 1.0], dtype=torch.float64))


def test_gradcheck_with_respect_to_extrinsics_and_intrinsics():
    gaussians, cameras = scene(3, 2, cameras=2)
    cameras.intrinsics[:, 0, 1] = 2.0
    leaves = [cameras.extrinsics.clone().requires_grad_(), cameras.intrinsics.clone().requires_grad_()]

    def run(extrinsics, intrinsics):
        return packed(inner(gaussians), PinholeCamera(intrinsics, extrinsics, cameras.height, cameras.width))

    assert torch.autograd.gradcheck(run, leaves, atol=1e-6)


@pytest.mark.parametrize(
    "kind", [CameraModelType.BROWN_CONRADY, CameraModelType.KANNALA_BRANDT_K3, CameraModelType.ORTHOGRAPHIC]
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


# -- errors --------------------------------------------------------------------------------------------------------


def test_dtype_and_device_of_cameras_and_gaussians_must_agree():
    gaussians, cameras = scene()
    with pytest.raises(TypeError, match=r"cameras: expected torch.float64 on cpu .* got torch.float32 on cpu"):
        project(gaussians, random_camera(HEIGHT, WIDTH, 0, torch.float32))
    elsewhere = Gaussians(*(getattr(gaussians, name).to("meta") for name in FIELDS))
    with pytest.raises(TypeError, match="cameras: expected torch.float64 on meta"):
        project(elsewhere, cameras)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_intrinsics_of_another_dtype_are_refused_too(dtype):
    gaussians, cameras = scene(dtype=dtype)
    other = torch.float32 if dtype == torch.float64 else torch.float64
    mixed = PinholeCamera(cameras.intrinsics.to(other), cameras.extrinsics, cameras.height, cameras.width)
    with pytest.raises(TypeError, match=f"cameras: expected {dtype} on cpu .* got {other} on cpu"):
        project(gaussians, mixed)
    for kind in CameraModelType:
        params = torch.tensor([60.0, 60, 31, 24, *[0.0] * LENGTHS[kind]], dtype=other)
        with pytest.raises(TypeError, match=f"cameras: expected {dtype} on cpu .* got {other} on cpu"):
            project(gaussians, posed(kind, params, cameras.extrinsics))


def test_camera_errors():
    gaussians, cameras = scene(cameras=2)
    with pytest.raises(TypeError, match="cameras: expected a kornia PinholeCamera or a kgs.PosedCamera"):
        project(gaussians, cameras.extrinsics)
    sizes = PinholeCamera(cameras.intrinsics, cameras.extrinsics, torch.tensor([48, 47]), torch.tensor([64, 64]))
    with pytest.raises(ValueError, match="cameras: expected one image size"):
        project(gaussians, sizes)


def test_the_public_name():
    assert kgs.project is project
