import ast
import itertools
import math
from pathlib import Path

import mpmath
import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from oracles import (
    enumerate_drops,
    mpmath_pixels,
    near_threshold,
    pinhole,
    random_camera,
    random_gaussians,
    real_harmonic,
    theta_mass,
)
from torch import Tensor

import kgs.reference
from kgs import Gaussians
from kgs.reference import layers, render

EXACT = {"alpha_threshold": 0.0, "transmittance_stop": 0.0}
NAMES = ("means", "quats", "scales", "opacities", "colors")


def tensor(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def fields(gaussians: Gaussians) -> dict[str, Tensor]:
    return {name: getattr(gaussians, name) for name in NAMES}


def replace(gaussians: Gaussians, **changes: Tensor) -> Gaussians:
    return Gaussians(**{**fields(gaussians), **changes})


def posed(camera: PinholeCamera, **changes: Tensor) -> PinholeCamera:
    values = {"intrinsics": camera.intrinsics[0], "extrinsics": camera.extrinsics[0], **changes}
    return PinholeCamera(values["intrinsics"][None], values["extrinsics"][None], camera.height, camera.width)


def stack(opacities: list[float], colors: list[list[float]], scale: float = 1e6) -> Gaussians:
    """Layers on the optical axis at depths 1, 2, 3, ...; by default so wide that alpha is constant over the image."""
    n = len(opacities)
    means = torch.zeros(n, 3, dtype=torch.float64)
    means[:, 2] = torch.arange(1, n + 1)
    quats = tensor([1, 0, 0, 0]).expand(n, 4)
    return Gaussians(means, quats, torch.full((n, 3), scale).to(means), tensor(*opacities), tensor(*colors))


def one(
    mean: list[float], scale: list[float], opacity: float = 0.8, quat: tuple[float, ...] = (1, 0, 0, 0)
) -> Gaussians:
    return Gaussians(tensor(mean), tensor(quat), tensor(scale), tensor(opacity), tensor([1.0, 0.5, 0.25]))


def grid(height: int, width: int) -> tuple[Tensor, Tensor]:
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    return x, y


SMALL = pinhole(4, 5, 10)
RED, GREEN, BLUE = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]


# closed forms


def test_isotropic_gaussian_on_the_axis():
    x, y = grid(15, 17)
    image = render(one([0, 0, 2], [0.1] * 3), pinhole(15, 17, 50), **EXACT)
    variance = (50 * 0.1 / 2) ** 2 + 0.3
    expected = 0.8 * torch.exp(-((x - 8) ** 2 + (y - 7) ** 2) / (2 * variance))
    assert image.shape == (1, 3, 15, 17)
    assert image.dtype == torch.float64
    for channel, color in enumerate((1.0, 0.5, 0.25)):
        torch.testing.assert_close(image[0, channel], color * expected, rtol=0, atol=1e-14)


def test_anisotropic_gaussian_on_the_axis_turned_about_it():
    x, y = grid(15, 17)
    camera = pinhole(15, 17, (50, 80))
    quarter = (math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4))  # local x -> world y
    image = render(one([0, 0, 2], [0.1, 0.05, 0.3], quat=quarter), camera, **EXACT)
    xx, yy = (50 * 0.05 / 2) ** 2 + 0.3, (80 * 0.1 / 2) ** 2 + 0.3
    expected = 0.8 * torch.exp(-((x - 8) ** 2) / (2 * xx) - (y - 7) ** 2 / (2 * yy))
    torch.testing.assert_close(image[0, 0], expected, rtol=0, atol=1e-14)


def test_a_point_lands_on_the_pixel_with_integer_centre():
    camera = pinhole(20, 30, (40, 60), centre=(12.0, 5.0))
    image = render(one([1.0, 0.4, 4.0], [1e-3] * 3), camera, **EXACT)[0, 0]
    row, column = divmod(int(image.argmax()), 30)
    assert (row, column) == (60 * 0.4 / 4 + 5, 40 * 1.0 / 4 + 12)
    assert float(image[row, column]) == pytest.approx(0.8, abs=1e-12)
    patch = image[row - 3 : row + 4, column - 3 : column + 4]
    torch.testing.assert_close(patch, patch.flip(0, 1), rtol=0, atol=1e-12)


def test_distant_camera_is_orthographic():
    gaussian = one([3.0, -2.0, 0.0], [1.0, 2.5, 4.0], quat=(0.7, 0.4, -0.3, 0.5))
    extrinsics = torch.eye(4, dtype=torch.float64)
    extrinsics[2, 3] = 1e6
    image = render(gaussian, pinhole(21, 21, 1e6, extrinsics=extrinsics), **EXACT)[0, 0]
    w, qx, qy, qz = (gaussian.quats[0] / gaussian.quats[0].norm()).tolist()
    first = tensor(1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - w * qz), 2 * (qx * qz + w * qy))
    second = tensor(2 * (qx * qy + w * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - w * qx))
    a, b, c = (u @ (gaussian.scales[0] ** 2 * v) for u, v in ((first, first), (first, second), (second, second)))
    x, y = grid(21, 21)
    dx, dy, a, c = x - 13, y - 8, a + 0.3, c + 0.3
    expected = 0.8 * torch.exp(-0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b))
    torch.testing.assert_close(image, expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize("scale", [1e-3, 0.02, 0.1])
def test_mass_is_jacobis_theta_function(scale):
    camera = pinhole(41, 43, 30, centre=(20.3, 19.6))
    image = render(one([0, 0, 2], [scale] * 3), camera, **EXACT)
    variance = (30 * scale / 2) ** 2 + 0.3
    assert float(image[0, 0].sum()) == pytest.approx(
        0.8 * theta_mass(variance, 20.3) * theta_mass(variance, 19.6), rel=1e-12
    )


def test_three_layers_by_hand():
    a, b, c = 0.5, 0.25, 0.8
    background = tensor(0.2, 0.4, 0.6)
    image = render(stack([a, b, c], [RED, GREEN, BLUE]), SMALL, background, **EXACT)
    rest = (1 - a) * (1 - b) * (1 - c)
    expected = tensor(a, (1 - a) * b, (1 - a) * (1 - b) * c) + rest * background
    torch.testing.assert_close(image, expected[None, :, None, None].expand_as(image), rtol=0, atol=1e-9)


def test_equal_layers():
    image = render(stack([0.3] * 7, [RED] * 7), SMALL, **EXACT)
    assert float((image[0, 0] - (1 - 0.7**7)).abs().max()) < 1e-9


def test_weights_and_transmittance_are_a_partition_of_unity():
    drawn = layers(random_gaussians(80, 0), random_camera(12, 14, 0), **EXACT)
    assert float((drawn.weights.sum(0) + drawn.transmittance - 1).abs().max()) < 1e-14
    gaussians = random_gaussians(80, 0, sh_degree=None)
    grey = replace(gaussians, colors=torch.full_like(gaussians.colors, 0.7))
    camera = random_camera(12, 14, 0)
    image = render(grey, camera, torch.full((3,), 0.7, dtype=torch.float64), **EXACT)
    assert float((image - 0.7).abs().max()) < 1e-14


def test_layers_give_depth_and_median_depth():
    drawn = layers(stack([0.4, 0.3, 0.5], [RED] * 3), SMALL, **EXACT)
    assert drawn.order.tolist() == [0, 1, 2]
    assert drawn.depths.tolist() == [1, 2, 3]
    alpha = 1 - drawn.transmittance
    depth = torch.einsum("lhw,l->hw", drawn.weights, drawn.depths) / alpha
    w = [0.4, 0.6 * 0.3, 0.6 * 0.7 * 0.5]
    torch.testing.assert_close(depth, torch.full_like(depth, (w[0] + 2 * w[1] + 3 * w[2]) / sum(w)), atol=1e-8, rtol=0)
    behind = 1 - drawn.weights.cumsum(0)
    assert (drawn.depths[(behind < 0.5).int().argmax(0)] == 2).all()


@pytest.mark.parametrize("form", [(3,), (1, 3), (1, 3, 4, 5)])
def test_background_forms(form):
    color = tensor(0.2, 0.4, 0.6)
    background = color[None, :, None, None].expand(1, 3, 4, 5) if len(form) == 4 else color.reshape(form)
    image = render(stack([0.25], [RED], scale=1e9), SMALL, background, **EXACT)
    torch.testing.assert_close(image[0, :, 2, 3], tensor(0.4, 0.3, 0.45), rtol=0, atol=1e-12)


# 50 digits


@pytest.mark.parametrize("thresholds", [(0.0, 0.0), (1 / 255, 1e-4), (1 / 32, 0.2)])
@pytest.mark.parametrize("sh_degree", [None, 3])
def test_fifty_digits(sh_degree, thresholds):
    gaussians = random_gaussians(15, 3, sh_degree=sh_degree)
    gaussians = replace(gaussians, opacities=gaussians.opacities * 1.25)
    camera = random_camera(24, 32, 4)
    camera.intrinsics[0, 0, 1] = 2.5  # skew
    pixels = [(0, 0), (5, 7), (12, 20), (23, 31), (14, 11)]
    expected = tensor(*mpmath_pixels(gaussians, camera, pixels, (0.1, 0.2, 0.3), *thresholds))
    image = render(gaussians, camera, tensor(0.1, 0.2, 0.3), *thresholds)[0]
    actual = torch.stack([image[:, row, column] for row, column in pixels])
    assert float((actual - expected).abs().max()) < 1e-13
    if thresholds == (0.0, 0.0):
        assert float((expected - tensor(0.1, 0.2, 0.3)).abs().amax(1).min()) > 1e-3  # every pixel shows something


def test_fifty_digits_beyond_the_tangent_limits():
    camera = pinhole(16, 16, 20, centre=(5.0, 9.0))
    limit = (16 - 0.5 - 5.0 + 0.15 * 16) / 20
    gaussians = random_gaussians(4, 0, sh_degree=None)
    tangents = tensor([0.99 * limit, 0.1], [1.01 * limit, -0.2], [3 * limit, 0.0], [-2.0, 2.0])
    gaussians = replace(
        gaussians,
        means=torch.cat([2 * tangents, torch.full((4, 1), 2.0)], 1),
        scales=torch.full((4, 3), 0.5).double() * tensor(1.0, 0.6, 0.8),
    )
    pixels = list(itertools.product((0, 7, 15), (0, 7, 15)))
    image = render(gaussians, camera, **EXACT)[0]
    expected = tensor(*mpmath_pixels(gaussians, camera, pixels))
    assert float(expected.max()) > 0.1
    assert float((torch.stack([image[:, r, c] for r, c in pixels]) - expected).abs().max()) < 1e-13


# harmonics


def harmonics_at(direction: Tensor, degree: int = 3) -> Tensor:
    """The basis as the renderer sees it: the colours of one coefficient each, seen along `direction`."""
    direction = direction / direction.norm()
    frame = torch.linalg.qr(torch.stack([direction, tensor(0.3, -0.5, 0.8), tensor(-0.6, 0.2, 0.7)], 1)).Q
    extrinsics = torch.eye(4, dtype=torch.float64)
    extrinsics[:3, :3] = torch.stack([frame[:, 1], frame[:, 2], direction])
    eye = tensor(0.4, -1.0, 2.0)
    extrinsics[:3, 3] = -extrinsics[:3, :3] @ eye
    size = (degree + 1) ** 2
    colors = 0.3 * torch.eye(size, dtype=torch.float64)[:, :, None].expand(size, size, 3)
    gaussians = Gaussians(
        (eye + 2.5 * direction).expand(size, 3),
        tensor([1, 0, 0, 0]).expand(size, 4),
        torch.ones(size, 3).double(),
        torch.ones(size).double(),
        colors,
    )
    rgb = layers(gaussians, pinhole(3, 3, 5, extrinsics=extrinsics)).colors
    return (rgb[:, 0] - 0.5) / 0.3


AXES = [list(map(float, row)) for sign in (1, -1) for row in (sign * torch.eye(3)).tolist()]
DIRECTIONS = [*AXES, [0.3, -0.7, 0.5], [-0.2, 0.9, -0.4], [1e-9, 2e-9, 1.0], [0.6, 0.8, 1e-9]]


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_harmonics_against_mpmath_and_the_addition_theorem(direction):
    basis = harmonics_at(tensor(*direction))
    with mpmath.workdps(50):
        x, y, z = map(mpmath.mpf, direction)
        polar, azimuth = mpmath.acos(z / mpmath.norm([x, y, z])), mpmath.atan2(y, x)
        expected = [float(real_harmonic(index, polar, azimuth)) for index in range(16)]
    torch.testing.assert_close(basis, tensor(*expected), rtol=0, atol=1e-14)
    for degree in range(4):
        band = basis[degree**2 : (degree + 1) ** 2]
        assert float((band**2).sum()) == pytest.approx((2 * degree + 1) / (4 * math.pi), rel=1e-13)


def test_harmonics_against_scipy():
    special = pytest.importorskip("scipy.special")
    x, y, z = (tensor(-0.4, 0.5, 0.77) / tensor(-0.4, 0.5, 0.77).norm()).tolist()
    basis = harmonics_at(tensor(x, y, z))
    for degree in range(4):
        for m in range(-degree, degree + 1):
            value = special.sph_harm_y(degree, abs(m), math.acos(z), math.atan2(y, x))
            expected = value.real if m == 0 else math.sqrt(2) * (value.real if m > 0 else value.imag)
            assert float(basis[degree * degree + degree + m]) == pytest.approx(float(expected), abs=1e-14)


def test_harmonics_have_the_order_and_signs_of_ply_files():
    x, y, z = (tensor(0.48, -0.6, 0.64)).tolist()
    expected = [
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    torch.testing.assert_close(harmonics_at(tensor(x, y, z)), tensor(*expected), rtol=0, atol=1e-14)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_lower_degree_is_the_beginning_of_a_higher_one(degree):
    direction = tensor(0.3, -0.7, 0.5)
    torch.testing.assert_close(harmonics_at(direction, degree), harmonics_at(direction)[: (degree + 1) ** 2])


def test_negative_colours_become_black_and_pass_no_gradient():
    colors = tensor([[0.0] * 3], [[-5.0, 0.0, 5.0]])[1:].requires_grad_()
    gaussians = Gaussians(tensor([0, 0, 2]), tensor([1, 0, 0, 0]), tensor([1, 1, 1]), tensor(0.5), colors)
    rgb = layers(gaussians, SMALL).colors
    assert rgb[0, 0] == 0
    rgb.sum().backward()
    torch.testing.assert_close(colors.grad[0, 0], tensor(0.0, 1.0, 1.0) * 0.28209479177387814)


# exactness of structure


def test_image_is_affine_in_each_opacity():
    gaussians, camera = random_gaussians(8, 1, sh_degree=1, opacities=(0.1, 0.45)), random_camera(8, 9, 1)
    weights = torch.rand(1, 3, 8, 9, generator=torch.Generator().manual_seed(0)).double()
    opacities = gaussians.opacities.clone().requires_grad_()

    def loss(values: Tensor) -> Tensor:
        return (render(replace(gaussians, opacities=values), camera, tensor(0.3, 0.2, 0.1), **EXACT) * weights).sum()

    loss(opacities).backward()
    for i, step in itertools.product(range(8), (0.5, -0.1)):
        moved = gaussians.opacities.clone()
        moved[i] += step
        slope = float(loss(moved) - loss(gaussians.opacities)) / step
        assert slope == pytest.approx(float(opacities.grad[i]), abs=1e-12, rel=1e-12)


def test_image_is_linear_in_colours_and_background():
    gaussians, camera = random_gaussians(8, 2, sh_degree=None), random_camera(8, 9, 2)
    colors, background = gaussians.colors, tensor(0.3, 0.2, 0.1)
    other = torch.rand(8, 3, generator=torch.Generator().manual_seed(0)).double()
    sums = render(replace(gaussians, colors=colors + 2 * other), camera, 3 * background)
    first = render(gaussians, camera)
    second = render(replace(gaussians, colors=other), camera)
    third = render(replace(gaussians, colors=torch.zeros_like(other)), camera, background)
    assert float((sums - first - 2 * second - 3 * third).abs().max()) < 1e-14


def test_dropping_is_unbiased_while_nothing_is_clamped():
    gaussians, camera = random_gaussians(7, 3, opacities=(0.2, 0.75)), random_camera(6, 7, 3)

    def dropped(factors: Tensor) -> Tensor:
        return render(
            replace(gaussians, opacities=gaussians.opacities * factors), camera, tensor(0.1, 0.5, 0.9), **EXACT
        )

    expected = dropped(torch.ones(7).double())
    assert float((enumerate_drops(7, 0.2, dropped) - expected).abs().max()) < 1e-14


def test_order_of_the_gaussians_does_not_matter():
    gaussians, camera = random_gaussians(60, 4, sh_degree=2), random_camera(12, 13, 4)
    order = torch.randperm(60, generator=torch.Generator().manual_seed(0))
    shuffled = Gaussians(**{name: value[order] for name, value in fields(gaussians).items()})
    assert torch.equal(render(gaussians, camera), render(shuffled, camera))


def test_equal_depths_keep_the_order_of_the_gaussians():
    gaussians = stack([0.6, 0.6, 0.6], [RED, GREEN, BLUE])
    gaussians = replace(gaussians, means=gaussians.means.clone().index_fill_(1, torch.tensor([2]), 2.0))
    image = render(gaussians, SMALL)
    torch.testing.assert_close(image[0, :, 0, 0], tensor(0.6, 0.24, 0.096), rtol=0, atol=1e-9)


def turn(axis: Tensor, angle: float) -> tuple[Tensor, Tensor]:
    """Quaternion and rotation matrix about an axis, the matrix by the exponential map."""
    axis = axis / axis.norm()
    quat = torch.cat([tensor(math.cos(angle / 2)), math.sin(angle / 2) * axis])
    generators = torch.stack([torch.linalg.cross(axis, column) for column in torch.eye(3).double()], 1)
    return quat, torch.linalg.matrix_exp(angle * generators)


def quaternion_product(p: Tensor, q: Tensor) -> Tensor:
    w, v, a, b = p[:1], p[1:], q[:, :1], q[:, 1:]
    return torch.cat([w * a - b @ v[:, None], w * b + a * v + torch.linalg.cross(v.expand_as(b), b)], 1)


def test_moving_world_and_camera_together_changes_nothing():
    gaussians, camera = random_gaussians(30, 5, sh_degree=None), random_camera(12, 13, 5)
    quat, rotation = turn(tensor(0.3, -0.8, 0.5), 1.1)
    shift = tensor(0.7, -2.0, 1.5)
    moved = replace(
        gaussians, means=gaussians.means @ rotation.T + shift, quats=quaternion_product(quat, gaussians.quats)
    )
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = rotation, shift
    seen = posed(camera, extrinsics=camera.extrinsics[0] @ torch.linalg.inv(motion))
    assert float((render(gaussians, camera) - render(moved, seen)).abs().max()) < 1e-13


@pytest.mark.parametrize("factor", [1e-3, 7.0, 1e4])
def test_scaling_the_world_changes_nothing(factor):
    gaussians, camera = random_gaussians(30, 6, sh_degree=3), random_camera(12, 13, 6)
    extrinsics = camera.extrinsics[0].clone()
    extrinsics[:3, 3] *= factor
    scaled = replace(gaussians, means=gaussians.means * factor, scales=gaussians.scales * factor)
    image = render(scaled, posed(camera, extrinsics=extrinsics), near_plane=0.01 * factor)
    assert float((render(gaussians, camera) - image).abs().max()) < 1e-13


def test_sign_and_norm_of_quaternions_do_not_matter():
    gaussians, camera = random_gaussians(30, 7), random_camera(12, 13, 7)
    image = render(gaussians, camera)
    assert torch.equal(image, render(replace(gaussians, quats=-gaussians.quats), camera))
    assert torch.equal(image, render(replace(gaussians, quats=gaussians.quats * 2.0**40), camera))


def test_zero_quaternion_is_the_identity_with_zero_gradient():
    quats = torch.zeros(1, 4, dtype=torch.float64, requires_grad=True)
    gaussians = replace(one([0.1, 0, 2], [0.1, 0.2, 0.3]), quats=quats)
    image = render(gaussians, SMALL)
    assert torch.equal(image, render(replace(gaussians, quats=tensor([1, 0, 0, 0])), SMALL))
    image.sum().backward()
    assert torch.equal(quats.grad, torch.zeros_like(quats))


def test_magnified_image_has_the_coarse_one_on_every_third_pixel():
    gaussians, camera = random_gaussians(30, 8), random_camera(9, 11, 8)
    intrinsics = camera.intrinsics[0].clone()
    intrinsics[:2, :2] *= 3
    intrinsics[:2, 2] = 3 * intrinsics[:2, 2] + 1
    fine = PinholeCamera(intrinsics[None], camera.extrinsics, 3 * camera.height, 3 * camera.width)
    image = render(gaussians, fine, eps2d=9 * 0.3)[..., 1::3, 1::3]
    assert float((render(gaussians, camera) - image).abs().max()) < 1e-13


def test_crop_is_a_window_of_the_image():
    camera, gaussians = random_camera(24, 30, 9), random_gaussians(40, 9)
    intrinsics = camera.intrinsics[0].clone()
    intrinsics[0, 2] -= 4
    intrinsics[1, 2] -= 3
    crop = PinholeCamera(intrinsics[None], camera.extrinsics, torch.tensor([18]), torch.tensor([22]))
    # only Gaussians inside both images' tangent limits keep the same Jacobian
    points = gaussians.means @ camera.extrinsics[0, :3, :3].T + camera.extrinsics[0, :3, 3]
    pixels = points[:, :2] / points[:, 2:] * intrinsics[:2, :2].diagonal() + intrinsics[:2, 2]
    size = tensor(22.0, 18.0)
    inside = ((pixels > -0.5 - 0.15 * size) & (pixels < size - 0.5 + 0.15 * size)).all(1)
    assert 20 < int(inside.sum()) < 40
    chosen = Gaussians(**{name: value[inside] for name, value in fields(gaussians).items()})
    image = render(chosen, camera)[..., 3:21, 4:26]
    assert float((render(chosen, crop) - image).abs().max()) < 1e-13


# what is left out


@pytest.mark.parametrize("z", [-5.0, -1e-30, 0.0, 0.01])
def test_nothing_up_to_the_near_plane_is_drawn(z):
    leaves = {name: value.clone().requires_grad_() for name, value in fields(one([0, 0, z], [0.1] * 3)).items()}
    background = tensor(0.2, 0.4, 0.6).requires_grad_()
    image = render(Gaussians(**leaves), SMALL, background)
    assert torch.equal(image, background.detach()[None, :, None, None].expand_as(image))
    image.sum().backward()
    assert all(torch.equal(leaf.grad, torch.zeros_like(leaf)) for leaf in leaves.values())


def test_just_behind_the_near_plane_is_drawn():
    z = math.nextafter(0.01, 1.0)
    means = tensor([0.0, 0.0, z]).requires_grad_()
    image = render(replace(one([0, 0, z], [0.1] * 3), means=means), SMALL)
    assert float(image[0, 0].detach().min()) > 0.7
    image.sum().backward()
    assert means.grad.isfinite().all()


def test_gaussians_behind_the_camera_change_no_bit():
    gaussians, camera = random_gaussians(20, 10), random_camera(8, 9, 10)
    behind = random_gaussians(1000, 11)
    behind = replace(behind, means=behind.means * tensor(1, 1, -1))
    both = Gaussians(*(torch.cat([getattr(behind, name), getattr(gaussians, name)]) for name in NAMES))
    assert torch.equal(render(gaussians, camera), render(both, camera))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_gaussian_that_is_not_finite_is_left_out(name, value):
    gaussians, camera = random_gaussians(10, 12, sh_degree=1), random_camera(8, 9, 12)
    leaves = {key: leaf.clone() for key, leaf in fields(gaussians).items()}
    leaves[name][4].view(-1)[0] = value
    leaves = {key: leaf.requires_grad_() for key, leaf in leaves.items()}
    extrinsics = camera.extrinsics[0].clone().requires_grad_()
    image = render(Gaussians(**leaves), posed(camera, extrinsics=extrinsics))
    keep = torch.arange(10) != 4
    others = Gaussians(*(getattr(gaussians, key)[keep] for key in NAMES))
    assert torch.equal(image, render(others, camera))
    image.sum().backward()
    assert extrinsics.grad.isfinite().all()
    assert all(leaf.grad.isfinite().all() and (leaf.grad[4] == 0).all() for leaf in leaves.values())


def test_no_gaussians_leave_the_background():
    gaussians = Gaussians(*(value[:0] for value in fields(random_gaussians(1, 0, sh_degree=3)).values()))
    assert torch.equal(render(gaussians, SMALL), torch.zeros(1, 3, 4, 5).double())


# clamp, threshold, stop


@pytest.mark.parametrize(("opacity", "slope"), [(0.98, 1.0), (0.99, 1.0), (0.995, 0.0), (1.3, 0.0)])
def test_alpha_is_clamped_at_099_with_the_clamps_gradient(opacity, slope):
    opacities = tensor(opacity).requires_grad_()
    gaussian = replace(one([0, 0, 2], [0.1] * 3), opacities=opacities)
    pixel = render(gaussian, pinhole(3, 3, 50), **EXACT)[0, 0, 1, 1]  # G = 1 in the centre
    assert float(pixel.detach()) == pytest.approx(min(opacity, 0.99), abs=1e-15)
    pixel.backward()
    assert opacities.grad.item() == slope


def test_opacity_above_one_widens_the_plateau():
    image = render(one([0, 0, 2], [0.2] * 3, opacity=1.25), pinhole(9, 9, 50), **EXACT)[0, 0]
    g = render(one([0, 0, 2], [0.2] * 3, opacity=1.0 - 1e-2), pinhole(9, 9, 50), **EXACT)[0, 0] / 0.99
    torch.testing.assert_close(image, (1.25 * g).clamp(max=0.99), rtol=0, atol=1e-14)
    assert int((image == 0.99).sum()) > 5


def test_alpha_below_the_threshold_is_skipped():
    drawn = stack([1 / 256, 0.5, 1 / 254], [RED, GREEN, BLUE], scale=1e9)
    image = render(drawn, SMALL, transmittance_stop=0.0)
    torch.testing.assert_close(image[0, :, 1, 1], tensor(0.0, 0.5, 0.5 / 254), rtol=0, atol=1e-12)
    image = render(drawn, SMALL, alpha_threshold=0.0, transmittance_stop=0.0)
    torch.testing.assert_close(
        image[0, :, 1, 1], tensor(1 / 256, 0.5 * 255 / 256, 0.5 * 255 / 256 / 254), atol=1e-12, rtol=0
    )


def test_alpha_at_the_threshold_is_drawn():
    assert float(render(one([0, 0, 2], [0.1] * 3, 0.25), pinhole(3, 3, 50), None, 0.25)[0, 0, 1, 1]) == 0.25


def test_threshold_is_each_pixels_own():
    x, y = grid(31, 31)
    gaussian = one([0, 0, 2], [0.2] * 3, opacity=0.5)
    exact = render(gaussian, pinhole(31, 31, 50), **EXACT)
    image = render(gaussian, pinhole(31, 31, 50))
    variance = 25.0 + 0.3
    radius = math.sqrt(2 * variance * math.log(0.5 * 255))
    inside = (x - 15) ** 2 + (y - 15) ** 2 <= radius**2
    assert 0 < int(inside.sum()) < 31 * 31
    assert torch.equal(image, exact * inside)


def test_the_layer_that_crosses_the_stop_counts_and_no_later_one():
    background = tensor(1.0, 1.0, 1.0)
    opaque = stack([0.99, 0.99, 0.99], [RED, GREEN, BLUE], scale=1e9)
    image = render(opaque, SMALL, background, transmittance_stop=1e-3)
    torch.testing.assert_close(image[0, :, 0, 0], tensor(0.99, 0.0099, 0.0), rtol=0, atol=1e-12)
    drawn = layers(opaque, SMALL, transmittance_stop=1e-3)
    assert (drawn.transmittance == 0).all()
    assert (drawn.weights[2] == 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_two_opaque_layers_do_not_let_the_background_shine_through(dtype):
    opaque = stack([0.99, 0.99], [RED, GREEN], scale=1e9)
    opaque = Gaussians(**{name: value.to(dtype) for name, value in fields(opaque).items()})
    image = render(opaque, pinhole(4, 5, 10, dtype=dtype), torch.ones(3, dtype=dtype))
    assert image.dtype == torch.float64
    assert float((image[0, :, 0, 0] - tensor(0.99, 0.0099, 0.0)).abs().max()) < 2e-4


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("threshold", "stop"), [(1 / 255, 0.0), (1 / 32, 0.0), (0.0, 1e-4), (0.0, 0.3), (1 / 64, 1e-2)]
)
def test_error_of_the_thresholds_is_bounded(seed, threshold, stop):
    gaussians, camera = random_gaussians(400, seed, sh_degree=None, opacities=(0.01, 1.2)), random_camera(20, 20, seed)
    exact = layers(gaussians, camera, **EXACT)
    difference = render(gaussians, camera, torch.ones(3), threshold, stop) - render(
        gaussians, camera, torch.ones(3), **EXACT
    )
    alphas = exact.responses.clamp(max=0.99)
    skipped = ((alphas < threshold) * alphas).sum(0)
    assert (difference.abs() <= skipped + stop + 1e-14).all()
    assert float(difference.abs().max()) > 0


def test_finer_thresholds_come_closer():
    gaussians, camera = random_gaussians(150, 5, opacities=(0.3, 1.2)), random_camera(20, 20, 5)
    exact = render(gaussians, camera, **EXACT)

    def error(threshold: float, stop: float) -> float:
        return float((render(gaussians, camera, None, threshold, stop) - exact).square().mean())

    by_threshold = [error(threshold, 0.0) for threshold in (1 / 16, 1 / 64, 1 / 255, 1e-4, 0.0)]
    by_stop = [error(0.0, stop) for stop in (0.3, 1e-1, 1e-2, 1e-4, 0.0)]
    for errors in (by_threshold, by_stop):
        assert errors == sorted(errors, reverse=True)
        assert errors[0] > 0
        assert errors[-1] == 0


def test_pixels_near_a_threshold_are_found():
    wide = {"scale": 1e9}
    assert near_threshold(stack([1 / 255 * (1 + 1e-6)], [RED], **wide), SMALL).all()
    assert near_threshold(stack([0.99 * (1 - 1e-6)], [RED], **wide), SMALL).all()
    assert near_threshold(stack([0.99, 0.99], [RED, RED], **wide), SMALL).all()
    assert near_threshold(stack([0.5], [RED], **wide), SMALL, transmittance_stop=0.5).all()
    assert not near_threshold(stack([0.5, 0.3, 0.98], [RED] * 3, **wide), SMALL).any()
    ordinary = near_threshold(random_gaussians(100, 0), random_camera(24, 24, 0), rel=1e-2)
    assert 0 < int(ordinary.sum()) < 400


# gradients


def scene(seed: int, sh_degree: int | None = 3) -> tuple[Gaussians, PinholeCamera]:
    """Four Gaussians inside the tangent limits of a 6x6 camera with skew; no colour or alpha at a clamp."""
    gaussians = random_gaussians(4, seed, sh_degree=sh_degree, image_size=6, opacities=(0.2, 0.9))
    camera = random_camera(6, 6, seed)
    camera.intrinsics[0, 0, 1] = 0.4
    gaussians = replace(gaussians, means=gaussians.means * tensor(0.6, 0.6, 1), scales=gaussians.scales / 2)
    return gaussians, camera


@pytest.mark.parametrize("sh_degree", [None, 3])
def test_gradients_of_all_inputs(sh_degree):
    gaussians, camera = scene(0, sh_degree)
    colors = gaussians.colors if sh_degree is None else gaussians.colors / 4

    def image(means, quats, scales, opacities, colors, extrinsics, intrinsics, background):
        seen = posed(camera, extrinsics=extrinsics, intrinsics=intrinsics)
        return render(Gaussians(means, quats, scales, opacities, colors), seen, background, **EXACT)

    inputs = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors]
    inputs += [camera.extrinsics[0], camera.intrinsics[0], tensor(0.1, 0.5, 0.9)]
    inputs = [value.detach().clone().requires_grad_() for value in inputs]
    assert torch.autograd.gradcheck(image, inputs, eps=1e-6, atol=1e-7)
    for value, gradient in zip(inputs, torch.autograd.grad(image(*inputs).square().sum(), inputs), strict=True):
        assert float(gradient.abs().max()) > 1e-4, value.shape


@pytest.mark.parametrize("fraction", [0.5, 0.99, 1.01, 3.0])
def test_gradient_follows_the_tangent_clamp(fraction):
    camera = pinhole(6, 6, 8, centre=(1.5, 3.0))
    limit = (6 - 0.5 - 1.5 + 0.15 * 6) / 8
    gaussians, _ = scene(1, None)
    means = tensor([2 * fraction * limit, 0.3, 2.0], [-0.3, -3 * fraction, 3.0])
    scales, quats = tensor([0.6, 0.9, 0.4], [1.0, 0.7, 0.5]), gaussians.quats[:2]

    def image(means, scales, extrinsics):
        two = Gaussians(means, quats, scales, gaussians.opacities[:2], gaussians.colors[:2])
        return render(two, posed(camera, extrinsics=extrinsics), **EXACT)

    inputs = [value.requires_grad_() for value in (means, scales, camera.extrinsics[0].clone())]
    assert torch.autograd.gradcheck(image, inputs, eps=1e-6, atol=1e-7)


def test_tangent_limits_are_constants_for_the_gradient():
    camera = pinhole(6, 6, 8, centre=(1.5, 3.0))
    gaussian = one([4.0, 0.3, 2.0], [0.9, 0.6, 1.2])  # beyond the right limit

    def response(intrinsics: Tensor) -> Tensor:
        return layers(gaussian, posed(camera, intrinsics=intrinsics), **EXACT).responses[0]

    intrinsics = camera.intrinsics[0].clone().requires_grad_()
    value = response(intrinsics)
    value[3, 4].backward()
    # the centre alone shifts the image; log o G is quadratic in the pixel, so that central differences are exact
    log = value.detach().log()
    slope = tensor((log[3, 5] - log[3, 3]) / 2, (log[4, 4] - log[2, 4]) / 2)
    torch.testing.assert_close(intrinsics.grad[:2, 2], -value.detach()[3, 4] * slope, rtol=1e-10, atol=0)
    # along this line of focal length and centre the limit stays where it is
    line = torch.zeros_like(camera.intrinsics[0])
    line[0, 0], line[0, 2] = 1.0, -(6 - 0.5 - 1.5 + 0.15 * 6) / 8
    step = 1e-5
    difference = response(camera.intrinsics[0] + step * line) - response(camera.intrinsics[0] - step * line)
    torch.testing.assert_close((intrinsics.grad * line).sum(), difference[3, 4] / (2 * step), rtol=1e-7, atol=0)


def test_gradients_obey_the_invariances():
    gaussians, camera = scene(2)
    leaves = {name: value.clone().requires_grad_() for name, value in fields(gaussians).items()}
    extrinsics = camera.extrinsics[0].clone().requires_grad_()
    image = render(Gaussians(**leaves), posed(camera, extrinsics=extrinsics), **EXACT)
    (image * torch.rand(image.shape, generator=torch.Generator().manual_seed(0))).sum().backward()
    rotation, translation = camera.extrinsics[0, :3, :3], camera.extrinsics[0, :3, 3]
    shift = leaves["means"].grad.sum(0) - rotation.T @ extrinsics.grad[:3, 3]  # moving the world moves t by R d
    assert float(shift.abs().max()) < 1e-12
    growth = sum((leaves[name] * leaves[name].grad).sum() for name in ("means", "scales"))
    assert abs(float(growth.detach() + translation @ extrinsics.grad[:3, 3])) < 1e-12
    turning = (leaves["quats"] * leaves["quats"].grad).sum(1)
    assert float(turning.detach().abs().max()) < 1e-12


# what it takes


def test_opacities_of_one_camera_may_be_a_row():
    gaussians, camera = random_gaussians(10, 13), random_camera(8, 9, 13)
    assert torch.equal(
        render(gaussians, camera), render(replace(gaussians, opacities=gaussians.opacities[None]), camera)
    )


def test_wrong_arguments_are_named():
    gaussians = random_gaussians(3, 0)
    two = PinholeCamera(
        *(torch.cat([value, value]) for value in (SMALL.intrinsics, SMALL.extrinsics, SMALL.height, SMALL.width))
    )
    with pytest.raises(TypeError, match="camera: expected a kornia PinholeCamera, got str"):
        render(gaussians, "camera")
    with pytest.raises(ValueError, match="camera: expected one camera"):
        render(gaussians, two)
    with pytest.raises(ValueError, match="one row of opacities"):
        render(replace(gaussians, opacities=gaussians.opacities.expand(2, 3)), SMALL)
    with pytest.raises(ValueError, match="background: expected"):
        render(gaussians, SMALL, torch.zeros(2, 3))


def test_nothing_of_the_package_but_its_types_is_used():
    tree = ast.parse(Path(kgs.reference.__file__).read_text(encoding="utf-8"))
    modules = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    modules |= {"." * node.level + str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert modules == {"__future__", "math", "typing", "torch", "kornia.geometry.camera", ".types"}
