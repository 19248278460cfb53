"""What must hold of any renderer: linearity, invariances, exact windows; and what the reference takes."""

import ast
import itertools
import math
from pathlib import Path

import pytest
import torch
from factories import pinhole, random_camera, random_gaussians, replace, whole_matrices
from kornia.geometry.camera import PinholeCamera
from oracles import enumerate_drops, quaternion_product
from reference_checks import BLUE, EXACT, GREEN, RED, SMALL, fields, one, posed, stack, tensor
from torch import Tensor

import kgs.reference
from kgs import Gaussians
from kgs.reference import layers, render

# -- exactness of structure ----------------------------------------------------------------------------------------


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


def scene(seed: int, sh_degree: int | None = 3) -> tuple[Gaussians, PinholeCamera]:
    """Four Gaussians inside the tangent limits of a 6x6 camera with skew; no colour or alpha at a clamp."""
    gaussians = random_gaussians(4, seed, sh_degree=sh_degree, image_size=6, opacities=(0.2, 0.9))
    camera = random_camera(6, 6, seed)
    camera.intrinsics[0, 0, 1] = 0.4
    gaussians = replace(gaussians, means=gaussians.means * tensor(0.6, 0.6, 1), scales=gaussians.scales / 2)
    return gaussians, camera


# -- gradients -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sh_degree", [None, pytest.param(3, marks=pytest.mark.slow)])
def test_gradients_of_all_inputs(sh_degree):
    gaussians, camera = scene(0, sh_degree)
    colors = gaussians.colors if sh_degree is None else gaussians.colors / 4

    def image(means, quats, scales, opacities, colors, extrinsics, intrinsics, background):
        seen = posed(camera, extrinsics=extrinsics, intrinsics=whole_matrices(intrinsics)[0])
        return render(Gaussians(means, quats, scales, opacities, colors), seen, background, **EXACT)

    inputs = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors]
    inputs += [camera.extrinsics[0], camera.intrinsics[:, :2, :3], tensor(0.1, 0.5, 0.9)]
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


def test_the_gradient_of_the_lens_follows_the_tangent_limits():
    camera = pinhole(6, 6, 8, centre=(1.5, 3.0))
    gaussian = one([4.0, 0.3, 2.0], [0.9, 0.6, 1.2])  # beyond the right limit

    def response(intrinsics: Tensor) -> Tensor:
        return layers(gaussian, posed(camera, intrinsics=intrinsics), **EXACT).responses[0]

    intrinsics = camera.intrinsics[0].clone().requires_grad_()
    response(intrinsics)[3, 4].backward()
    for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)):
        step = torch.zeros_like(camera.intrinsics[0])
        step[row, column] = 1e-5
        difference = response(camera.intrinsics[0] + step) - response(camera.intrinsics[0] - step)
        torch.testing.assert_close(intrinsics.grad[row, column], difference[3, 4] / 2e-5, rtol=1e-7, atol=1e-9)


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


# -- what it takes -------------------------------------------------------------------------------------------------


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
    with pytest.raises(TypeError, match="^camera:"):
        render(gaussians, "camera")
    with pytest.raises(ValueError, match="^camera:"):
        render(gaussians, two)
    with pytest.raises(ValueError, match="one row of opacities"):
        render(replace(gaussians, opacities=gaussians.opacities.expand(2, 3)), SMALL)
    with pytest.raises(ValueError, match="^background:"):
        render(gaussians, SMALL, torch.zeros(2, 3))


def test_nothing_of_the_package_but_its_types_is_used():
    tree = ast.parse(Path(kgs.reference.__file__).read_text(encoding="utf-8"))
    modules = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    modules |= {"." * node.level + str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert modules == {"math", "dataclasses", "torch", "kornia.geometry.camera", ".types"}
