"""Normals, features and backgrounds of the renderer."""

import math

import pytest
import torch
from factories import leaves, one_gaussian, pinhole, posed, random_camera, random_gaussians, random_scene, replace
from kornia.sensors.camera import CameraModelType

import kgs
from kgs import GaussianRenderer

pytestmark = pytest.mark.usefixtures("each_backend")

EXACT = {"alpha_threshold": 0.0, "transmittance_stop": 0.0}
SIZE = (24, 32)


def test_a_disk_shows_its_face_whatever_side_the_camera_is_on():
    half = math.radians(20) / 2
    tilted = (math.cos(half), 0.0, math.sin(half), 0.0)  # about y
    disk = one_gaussian((5.0, 5.0, 0.01), tilted, (0.0, 0.0, 4.0), 0.9)
    for flipped in (False, True):
        pose = torch.eye(4, dtype=torch.float64)
        if flipped:  # from behind, looking back
            pose = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])).double()
            pose[2, 3] = 8.0
        out = GaussianRenderer()(disk, pinhole(9, 9, 20.0, extrinsics=pose), outputs=("normal", "alpha"))
        expected = torch.tensor([math.sin(2 * half), 0.0, math.cos(2 * half)]).double() * (1 if flipped else -1)
        got = (out.normal / out.alpha)[0, :, 4, 4]
        assert (got - expected).abs().max() < 1e-6


def test_normals_with_parallel_rays_are_turned_against_them():
    gaussians = random_gaussians(40, 0)
    camera = posed(CameraModelType.ORTHOGRAPHIC, (8.0, 8.0, 15.5, 11.5), SIZE)
    drawn = GaussianRenderer(**EXACT)(gaussians, camera, outputs=("normal",)).normal
    assert (drawn[:, 2] <= 0).all()
    assert drawn.abs().max() > 0.1


def test_normals_have_gradients():
    gaussians, camera = random_scene(0, torch.float32, 60, SIZE, cameras=2)
    given, inputs = leaves(gaussians)
    GaussianRenderer()(given, camera, outputs=("image", "normal")).normal.square().sum().backward()
    assert all(x.grad.isfinite().all() for x in inputs[:4])
    assert inputs[1].grad.any()

    def normal(quats):
        return GaussianRenderer(**EXACT)(replace(small, quats=quats), view, outputs=("normal",)).normal

    small, view = random_gaussians(4, 1), random_camera(8, 8, 1)
    assert torch.autograd.gradcheck(normal, small.quats.clone().requires_grad_(), fast_mode=True)


@pytest.mark.parametrize("shape", [(3,), (1, 3), (3, *SIZE), (1, 3, *SIZE)])
def test_an_infinite_background_shows_only_where_light_is_left(shape):
    wall = [one_gaussian((50.0, 50.0, 0.01), mean=(0.0, 0.0, z), opacity=0.99) for z in (3.0, 4.0, 5.0)]
    wall = kgs.Gaussians(*(torch.cat(x) for x in zip(*(vars(g).values() for g in wall), strict=True)))
    wall, inputs = leaves(wall)
    camera = pinhole(*SIZE, 20.0)
    background = torch.full(shape, math.inf, dtype=torch.float64, requires_grad=True)
    out = GaussianRenderer()(wall, camera, background, outputs=("image", "alpha"))
    assert (out.alpha == 1).all()
    assert torch.equal(out.image, GaussianRenderer()(wall, camera).image)
    out.image.square().sum().backward()
    assert all(x.grad.isfinite().all() for x in inputs)
    assert not background.grad.any()
    nothing = kgs.Gaussians(*(x.detach()[:0] for x in inputs))
    assert (GaussianRenderer()(nothing, camera, background).image == math.inf).all()
