"""Pixels and Jacobians against finite differences of Kornia, and the tangent clamp by its definition."""

import factories
import pytest
import torch
from factories import LENS_PARAMS, posed
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.vector import Vector3
from kornia.sensors.camera import CameraModelType

from kgs.geometry.cameras import image_size, pinhole_cameras
from kgs.geometry.lenses import lenses

HEIGHT, WIDTH = 48, 64
INTRINSICS = LENS_PARAMS[CameraModelType.PINHOLE]  # fx fy cx cy, off centre
KINDS = list(LENS_PARAMS)
PERSPECTIVE = KINDS[:3]


def pinhole(skew=0.0):
    return factories.pinhole(HEIGHT, WIDTH, INTRINSICS[:2], INTRINSICS[2:], skew)


def points(n=20, spread=0.45, seed=0, dtype=torch.float64):
    """In front of the camera, with |x/z| and |y/z| below `spread`."""
    random = torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    z = 1 + 3 * random[:, 2:]
    return torch.cat([spread * (2 * random[:, :2] - 1) * z, z], 1).to(dtype)


def all_cameras():
    return [pytest.param(pinhole(), id="pinhole"), pytest.param(pinhole(skew=3.0), id="skew")] + [
        pytest.param(posed(kind), id=kind.name) for kind in KINDS
    ]


def kornia_pixels(cameras, at):
    if isinstance(cameras, PinholeCamera):
        return cameras.project(at[None])[0]
    return cameras.model.project(Vector3(at)).data


@pytest.mark.parametrize("cameras", all_cameras())
def test_convention_pixels_are_kornias_and_jacobians_their_finite_differences(cameras):
    (lens,) = lenses(cameras)
    at, step = points(), 1e-6
    torch.testing.assert_close(lens.project(at), kornia_pixels(cameras, at), rtol=0, atol=0)
    columns = []
    for axis in range(3):
        shift = step * torch.eye(3, dtype=torch.float64)[axis]
        columns.append((kornia_pixels(cameras, at + shift) - kornia_pixels(cameras, at - shift)) / (2 * step))
    torch.testing.assert_close(lens.jacobian(at), torch.stack(columns, 2), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_of_one_camera_or_of_each(kind):
    base = torch.tensor(LENS_PARAMS[kind], dtype=torch.float64)
    rows = torch.stack([base, base * 1.1, base * 0.9])
    at = points()
    for shared in (base, base[None]):
        for lens in lenses(posed(kind, shared, cameras=3)):
            torch.testing.assert_close(lens.project(at), kornia_pixels(posed(kind, base), at), rtol=0, atol=0)
    for lens, row in zip(lenses(posed(kind, rows, cameras=3)), rows, strict=True):
        (single,) = lenses(posed(kind, row))
        torch.testing.assert_close(lens.project(at), kornia_pixels(posed(kind, row), at), rtol=0, atol=0)
        assert torch.equal(lens.jacobian(at), single.jacobian(at))


@pytest.mark.parametrize("kind", PERSPECTIVE)
def test_on_the_optical_axis_everything_is_finite(kind):
    (lens,) = lenses(posed(kind))
    at = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64, requires_grad=True)
    expected = torch.tensor([[[25, 0, 0], [0, 27.5, 0]]], dtype=torch.float64)
    jacobian = lens.jacobian(at)
    torch.testing.assert_close(jacobian.detach(), expected)
    (jacobian.sum() + lens.project(at).sum()).backward()
    assert at.grad.isfinite().all()


@pytest.mark.parametrize("cameras", all_cameras())
def test_without_gradients_the_values_are_the_same_and_no_graph_is_left(cameras):
    (lens,) = lenses(cameras)
    at = points(spread=1.5)
    expected = lens.jacobian(at.clone().requires_grad_())
    assert expected.requires_grad or lens.parallel
    for context in (torch.no_grad, torch.inference_mode):
        with context():
            got = lens.jacobian(at)
            assert torch.equal(got, expected)
            assert not got.requires_grad


@pytest.mark.parametrize("kind", KINDS)
def test_float32_stays_float32_and_is_close(kind):
    (lens,), (exact,) = lenses(posed(kind, dtype=torch.float32)), lenses(posed(kind))
    at = points(spread=1.5, dtype=torch.float32)
    assert lens.jacobian(at).dtype == lens.project(at).dtype == torch.float32
    torch.testing.assert_close(lens.jacobian(at).double(), exact.jacobian(at.double()), rtol=1e-4, atol=1e-4)


def far_points():
    """Tangents on all sides of the limits, which are (pixel coordinates of the widened image - centre) / focal."""
    tangents = torch.tensor([-3.0, -1.1, -0.85, -0.4, 0.3, 0.8, 0.9, 1.05, 3.0], dtype=torch.float64)
    x, y = (t.flatten() for t in torch.meshgrid(tangents, tangents, indexing="ij"))
    z = torch.linspace(0.5, 4, len(x), dtype=torch.float64)
    return torch.stack([x * z, y * z, z], 1)


def pulled_in(at):
    """The points at the same depth whose undistorted pixels lie at most 15 % of the size beyond the image's border."""
    fx, fy, cx, cy = INTRINSICS
    u = (fx * at[:, 0] / at[:, 2] + cx).clamp(-0.5 - 0.15 * WIDTH, WIDTH - 0.5 + 0.15 * WIDTH)
    v = (fy * at[:, 1] / at[:, 2] + cy).clamp(-0.5 - 0.15 * HEIGHT, HEIGHT - 0.5 + 0.15 * HEIGHT)
    return torch.stack([(u - cx) / fx * at[:, 2], (v - cy) / fy * at[:, 2], at[:, 2]], 1)


def unclamped(cameras, at):
    at = at.clone().requires_grad_()
    pixels = kornia_pixels(cameras, at)
    return torch.stack([torch.autograd.grad(pixels[:, i].sum(), at, retain_graph=True)[0] for i in (0, 1)], 1)


LIMITED = [pinhole(), pinhole(skew=3.0), *map(posed, KINDS[:2])]
UNLIMITED = [*map(posed, KINDS[2:])]  # fisheye and orthographic


@pytest.mark.parametrize("cameras", LIMITED + UNLIMITED)
def test_beyond_the_limits_the_jacobian_is_taken_at_the_limit_but_the_pixel_is_not(cameras):
    (lens,) = lenses(cameras)
    at = far_points()
    limited = pulled_in(at) if cameras in LIMITED else at
    inside = (at - pulled_in(at)).abs().amax(1) < 1e-12
    assert 0 < inside.sum() < len(at)
    torch.testing.assert_close(lens.jacobian(at), unclamped(cameras, limited), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(lens.jacobian(at)[inside], unclamped(cameras, at[inside]), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(lens.project(at), kornia_pixels(cameras, at), rtol=0, atol=1e-12)


@pytest.mark.parametrize("cameras", all_cameras()[:-1])  # the last one's Jacobian, orthographic, is constant
def test_gradcheck_with_respect_to_points_on_both_sides_of_the_limits(cameras):
    (lens,) = lenses(cameras)
    at = far_points()[::7].requires_grad_()
    assert torch.autograd.gradcheck(lens.jacobian, at, eps=1e-6, atol=1e-6)
    assert torch.autograd.gradcheck(lambda x: lens.project(x), at, eps=1e-6, atol=1e-6)


def test_a_size_that_changes_in_place_or_is_replaced_is_read_again():
    camera = pinhole_cameras(torch.eye(4), torch.eye(3), width=32, height=24)
    assert [image_size(camera) for _ in range(2)] == [(24, 32)] * 2
    camera.width += 8
    assert image_size(camera) == (24, 40)
    camera.height = torch.tensor([12])
    assert image_size(camera) == (12, 40)
