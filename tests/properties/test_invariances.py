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
def test_translation_keeps_the_view_dependent_colour(dtype, bound):
    gaussians, camera = scene(0, dtype, sh_degree=3)
    shift = torch.tensor([0.5, -1.0, 2.0], dtype=dtype)
    moved = dataclasses.replace(gaussians, means=gaussians.means + shift)
    pose = camera.extrinsics.clone()
    pose[0, :3, 3] -= pose[0, :3, :3] @ shift
    assert difference(EXACT, (gaussians, camera), (moved, with_camera(camera, pose))) <= bound


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


@pytest.mark.parametrize(("dtype", "bound"), DTYPES)
@pytest.mark.parametrize("axis", [0, 1])
def test_mirror(axis, dtype, bound):
    gaussians, camera = scene(0, dtype, sh_degree=0)
    flip = torch.ones(3, dtype=dtype)
    flip[axis] = -1
    # a rotation seen in a mirror turns the other way about the axes that lie in the mirror
    mirrored = dataclasses.replace(
        gaussians, means=gaussians.means * flip, quats=gaussians.quats * torch.cat([flip[:1].abs(), -flip])
    )
    intrinsics, pose = camera.intrinsics.clone(), camera.extrinsics.clone()
    size = (camera.width, camera.height)[axis]
    intrinsics[:, axis, 2] = size - 1 - intrinsics[:, axis, 2]
    full = torch.diag(torch.cat([flip, flip.new_ones(1)]))
    seen = PinholeCamera(intrinsics, full @ pose @ full, camera.height, camera.width)
    a, b = EXACT(gaussians, camera).image, EXACT(mirrored, seen).image
    assert (a - b.flip(3 - axis)).abs().max() <= bound


@pytest.mark.parametrize(("dtype", "bound"), DTYPES)
def test_a_quaternion_and_its_negative_and_its_multiples(dtype, bound):
    gaussians, camera = scene(0, dtype)
    expected = GaussianRenderer()(gaussians, camera, outputs=OUTPUTS)
    negative = dataclasses.replace(gaussians, quats=-gaussians.quats)
    assert_same(GaussianRenderer()(negative, camera, outputs=OUTPUTS), expected)
    for factor in (1e-20, 0.25, 1e20):
        longer = dataclasses.replace(gaussians, quats=gaussians.quats * factor)
        assert difference(EXACT, (longer, camera), (gaussians, camera)) <= bound


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 2e-6), (torch.float64, 1e-12)])
@pytest.mark.parametrize("window", [(0, 0, 40, 56), (3, 5, 20, 31), (11, 0, 29, 8), (20, 25, 2, 9)])
def test_crop_is_the_window_of_the_whole(window, dtype, bound):
    top, left, height, width = window
    gaussians, camera = scene(1, dtype)
    # within the tangent limits of the window, which reach 15 % beyond it: otherwise footprints differ by definition
    x, y = EXACT(gaussians, camera).projected.means2d.unbind(1)
    inside = (x > left - 0.5 - 0.15 * width) & (x < left + width - 0.5 + 0.15 * width)
    inside &= (y > top - 0.5 - 0.15 * height) & (y < top + height - 0.5 + 0.15 * height)
    gaussians = select(gaussians, inside)
    assert len(gaussians) > 0
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, 0, 2] -= left
    intrinsics[:, 1, 2] -= top
    crop = PinholeCamera(intrinsics, camera.extrinsics, torch.tensor([height]), torch.tensor([width]))
    a = EXACT(gaussians, camera, outputs=("image", "alpha"))
    b = EXACT(gaussians, crop, outputs=("image", "alpha"))
    for name in ("image", "alpha"):
        part = getattr(a, name)[:, :, top : top + height, left : left + width]
        assert (part - getattr(b, name)).abs().max() <= bound


@pytest.mark.parametrize(("dtype", "bound"), DTYPES)
@pytest.mark.parametrize("k", [3, 5])
def test_k_times_the_pixels_coincide_at_the_coarse_centres(k, dtype, bound):
    gaussians, camera = scene(0, dtype, n=60, size=(16, 20))
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, :2, :2] *= k
    intrinsics[:, :2, 2] = k * intrinsics[:, :2, 2] + (k - 1) / 2
    fine = PinholeCamera(intrinsics, camera.extrinsics, camera.height * k, camera.width * k)
    exact = {"alpha_threshold": 0, "transmittance_stop": 0}
    a = GaussianRenderer(**exact)(gaussians, camera, outputs=("image", "depth"))
    b = GaussianRenderer(eps2d=0.3 * k * k, **exact)(gaussians, fine, outputs=("image", "depth"))
    first = (k - 1) // 2
    assert b.image.shape == (1, 3, 16 * k, 20 * k)
    assert (a.image - b.image[:, :, first::k, first::k]).abs().max() <= bound
