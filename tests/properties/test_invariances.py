"""Changes of the scene that must not change the image, or must change it in a known way."""

import dataclasses

import pytest
import torch
from factories import OUTPUTS, leaves, random_camera, random_gaussians, select, with_camera
from kornia.geometry.camera import PinholeCamera
from oracles import quaternion_product

from kgs import GaussianRenderer

pytestmark = pytest.mark.usefixtures("each_backend")

# dtype, and the bound for images that are computed along different roads
DTYPES = [(torch.float32, 5e-6), (torch.float64, 1e-12)]
EXACT = GaussianRenderer(alpha_threshold=0, transmittance_stop=0)
SEEDS = [0, 1]


def scene(seed, dtype, n=150, size=(40, 56), sh_degree=2):
    return random_gaussians(n, seed, dtype, sh_degree), random_camera(*size, seed, dtype)


def assert_same(a, b, names=OUTPUTS):
    for name in names:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def outputs_and_gradients(gaussians, camera):
    gaussians, inputs = leaves(gaussians)
    out = GaussianRenderer()(gaussians, camera, outputs=OUTPUTS)
    return out, torch.autograd.grad(out.image.square().sum(), inputs)


def difference(renderer, first, second):
    images = [renderer(gaussians, camera).image for gaussians, camera in (first, second)]
    assert images[0].abs().max() > 0.1
    return (images[0] - images[1]).abs().max().item()


@pytest.mark.parametrize(("dtype", "_"), DTYPES)
@pytest.mark.parametrize("seed", SEEDS)
def test_the_order_of_the_gaussians_does_not_matter(seed, dtype, _):
    gaussians, camera = scene(seed, dtype)
    assert len(gaussians.means[:, 2].unique()) == len(gaussians)
    order = torch.randperm(len(gaussians), generator=torch.Generator().manual_seed(seed))
    first, plain = outputs_and_gradients(gaussians, camera)
    second, shuffled = outputs_and_gradients(select(gaussians, order), camera)
    assert_same(first, second)
    assert all(torch.equal(a[order], b) for a, b in zip(plain, shuffled, strict=True))


@pytest.mark.parametrize(("dtype", "bound"), DTYPES)
@pytest.mark.parametrize("seed", SEEDS)
def test_rigid_motion_of_world_and_camera(seed, dtype, bound):
    gaussians, camera = scene(seed, torch.float64, sh_degree=0)
    generator = torch.Generator().manual_seed(seed + 50)
    turn = torch.nn.functional.normalize(torch.randn(4, generator=generator, dtype=torch.float64), dim=0)
    conjugate = turn * torch.tensor([1.0, -1, -1, -1])
    shift = torch.randn(3, generator=generator, dtype=torch.float64)

    def rotate(points):
        pure = torch.cat([points.new_zeros(len(points), 1), points], 1)
        return quaternion_product(quaternion_product(turn.expand_as(pure), pure), conjugate.expand_as(pure))[:, 1:]

    moved = dataclasses.replace(
        gaussians,
        means=rotate(gaussians.means) + shift,
        quats=quaternion_product(turn.expand_as(gaussians.quats), gaussians.quats),
    )
    back = torch.eye(4, dtype=torch.float64)
    back[:3, :3] = rotate(torch.eye(3, dtype=torch.float64))  # its rows are the rotated axes: the inverse rotation
    back[:3, 3] = -back[:3, :3] @ shift
    posed = with_camera(camera, camera.extrinsics @ back)
    cameras = [
        PinholeCamera(c.intrinsics.to(dtype), c.extrinsics.to(dtype), c.height, c.width) for c in (camera, posed)
    ]
    assert difference(EXACT, (gaussians.to(dtype), cameras[0]), (moved.to(dtype), cameras[1])) <= bound


@pytest.mark.parametrize(("dtype", "bound"), DTYPES)
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 0.3, 1e3, 1e6])
def test_scale_of_the_world(scale, dtype, bound):
    gaussians, camera = scene(1, dtype, sh_degree=3)
    larger = dataclasses.replace(gaussians, means=gaussians.means * scale, scales=gaussians.scales * scale)
    pose = camera.extrinsics.clone()
    pose[:, :3, 3] *= scale
    options = {"alpha_threshold": 0, "transmittance_stop": 0}
    a = EXACT(gaussians, camera, outputs=("image", "depth"))
    renderer = GaussianRenderer(near_plane=0.01 * scale, **options)
    b = renderer(larger, with_camera(camera, pose), outputs=("image", "depth"))
    assert (a.image - b.image).abs().max() <= bound
    solid = 1 - EXACT(gaussians, camera, outputs=("alpha",)).alpha < 0.9
    assert ((a.depth - b.depth / scale).abs() * solid).max() <= 20 * bound
    # and with the default near plane a small world is behind it
    if scale <= 1e-3:
        assert len(GaussianRenderer()(larger, with_camera(camera, pose)).projected) == 0
