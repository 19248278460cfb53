"""Cameras of all kinds, batches of them, images of any size, tensors of any layout."""

import dataclasses
import math

import pytest
import torch
from factories import FIELDS, OUTPUTS, batch, leaves, pinhole, posed, random_camera, random_gaussians
from kornia.geometry.camera import PinholeCamera
from kornia.sensors.camera import CameraModelType

from kgs import GaussianRenderer, Gaussians

pytestmark = pytest.mark.usefixtures("each_backend")

DTYPES = [torch.float32, torch.float64]


def largest(a, b):
    return (a - b).abs().max().item()


@pytest.mark.parametrize("dtype", DTYPES)
def test_sixteen_cameras_at_once_are_sixteen_single_ones(dtype):
    singles = [random_camera(24, 30, seed, dtype) for seed in range(16)]
    gaussians, inputs = leaves(random_gaussians(50, 0, dtype, 2))
    renderer = GaussianRenderer()
    together = renderer(gaussians, batch(*singles), outputs=OUTPUTS)
    apart = [renderer(gaussians, camera, outputs=OUTPUTS) for camera in singles]
    for name in OUTPUTS:
        assert torch.equal(getattr(together, name), torch.cat([getattr(one, name) for one in apart])), name
    assert torch.equal(together.projected.camera_ids.bincount(), torch.tensor([len(one.projected) for one in apart]))
    gradients = torch.autograd.grad(together.image.square().sum(), inputs)
    expected = torch.autograd.grad(sum(one.image.square().sum() for one in apart), inputs)
    for a, b in zip(gradients, expected, strict=True):
        assert largest(a, b) <= (1e-5 if dtype == torch.float32 else 1e-13) * b.abs().max()


# 512 tiles in a row; 2^15 tiles and a few more, with the last of them lit; far more than 16 bits can number
@pytest.mark.parametrize(("size", "views"), [((16, 4096), 1), ((8, 131080), 2), ((64, 4096), 9)])
def test_many_tiles_keep_their_numbers(size, views, exactly):
    (height, width), dtype = size, exactly[0]
    columns = torch.linspace(3, width - 4, 41, dtype=torch.float64).round()
    means = torch.stack([(columns - (width - 1) / 2) / 2000, torch.zeros(41), torch.ones(41)], 1) * 2
    dots = Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(41, 1),
        scales=torch.full((41, 3), 1e-9, dtype=torch.float64),
        opacities=torch.linspace(0.3, 0.5, views, dtype=torch.float64)[:, None].expand(views, 41),
        colors=torch.rand(41, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.1,
    )
    lens = pinhole(height, width, (2000.0, 2000.0), dtype=dtype)
    image = GaussianRenderer()(dots.to(dtype), batch(*[lens] * views)).image
    lit = image[:, :, (height - 1) // 2 : height // 2 + 1].sum(2)  # the two middle rows share each dot
    scale = 2 * dots.opacities[:, :1, None] * math.exp(-0.5 * 0.25 / 0.3)
    assert (lit[:, :, columns.long()] - scale * dots.colors.T).abs().max() <= 1e-6
    dark = torch.ones(width, dtype=torch.bool)
    for shift in (-3, -2, -1, 0, 1, 2, 3):
        dark[columns.long() + shift] = False
    assert not image[..., dark].any()


@pytest.mark.parametrize("kind", [None, CameraModelType.PINHOLE, CameraModelType.BROWN_CONRADY])
def test_a_wide_render_shows_a_frame_as_a_render_of_the_frame_does(kind):
    """Gaussians far beside the frame would veil it otherwise: their footprints are linearised farther out."""
    height, width, wide = 24, 30, 120
    left = (wide - width) // 2
    gaussians = random_gaussians(60, 0, torch.float64, 0)
    gaussians.means[:20, 0] = torch.linspace(2.0, 4.0, 20, dtype=torch.float64) * gaussians.means[:20, 2]
    gaussians.scales[:20] = torch.tensor([0.05, 0.05, 2.0], dtype=torch.float64)
    gaussians.quats[:20] = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)

    def camera(columns, shift):
        centre = ((width - 1) / 2 + shift, (height - 1) / 2)
        if kind is None:
            return pinhole(height, columns, 40.0, centre)
        distortion = [0.05, -0.02, 0.01, 0.005, 0, 0, 0, 0] if kind is CameraModelType.BROWN_CONRADY else []
        return posed(kind, [40.0, 40.0, *centre, *distortion], size=(height, columns))

    frame = (left - 0.5, -0.5, left + width - 0.5, height - 0.5)
    expected = GaussianRenderer()(gaussians, camera(width, 0)).image
    inside = slice(left, left + width)
    framed = GaussianRenderer(frame=frame)(gaussians, camera(wide, left)).image[..., inside]
    assert largest(framed, expected) < 1e-12
    assert largest(GaussianRenderer()(gaussians, camera(wide, left)).image[..., inside], expected) > 1e-3
    if kind is None:  # in float32, on the compiled backend too
        values = {name: value.float() for name, value in vars(gaussians).items()}
        single = camera(wide, left)
        single = PinholeCamera(single.intrinsics.float(), single.extrinsics.float(), single.height, single.width)
        image = GaussianRenderer(frame=frame)(Gaussians(**values), single).image[..., inside]
        assert largest(image.double(), expected) < 1e-4


@pytest.mark.parametrize("n", [0, 3])
@pytest.mark.parametrize("views", [1, 3])
def test_nothing_to_see(n, views):
    gaussians = random_gaussians(n, 0, torch.float32, 1)
    behind, each = gaussians.means * torch.tensor([1.0, 1.0, -1.0]), gaussians.opacities.expand(views, n)
    gaussians = dataclasses.replace(gaussians, means=behind, opacities=each)
    gaussians, inputs = leaves(gaussians)
    background = torch.rand(3, requires_grad=True)
    cameras = batch(*[pinhole(9, 13, (20.0, 20.0), dtype=torch.float32)] * views)
    out = GaussianRenderer()(gaussians, cameras, background, OUTPUTS)
    assert torch.equal(out.image, background[None, :, None, None].expand(views, 3, 9, 13))
    for name in OUTPUTS[1:]:
        assert torch.equal(getattr(out, name), torch.zeros(views, 1, 9, 13))
    assert len(out.projected) == 0
    (out.image.sum() + out.alpha.sum() + out.depth.sum()).backward()
    for x in inputs:
        assert torch.equal(x.grad, torch.zeros_like(x))
    assert torch.equal(background.grad, torch.full((3,), views * 9.0 * 13.0))


@pytest.mark.parametrize("size", [(8, 8), (16, 24), (15, 17)])
def test_the_image_is_the_users_own_to_edit(size):
    gaussians, inputs = leaves(random_gaussians(20, 1))
    camera = random_camera(*size, 1)
    expected = torch.autograd.grad(GaussianRenderer()(gaussians, camera).image.clamp(0, 0.5).sum(), inputs)
    image = GaussianRenderer()(gaussians, camera).image
    image.clamp_(0, 0.5)
    for a, b in zip(torch.autograd.grad(image.sum(), inputs), expected, strict=True):
        assert torch.equal(a, b)


def strided(x):
    """The same values with every second element of the memory."""
    return torch.stack([x, x + 1], -1)[..., 0]


def transposed(x):
    return x.transpose(0, -1).contiguous().transpose(0, -1)


def expanded(x):
    """All rows are the first, whose memory they share."""
    return x[:1].expand_as(x)


@pytest.mark.parametrize("layout", [strided, transposed, expanded])
def test_layout_in_memory_does_not_matter(layout):
    gaussians, camera = random_gaussians(40, 0, torch.float32, 3), random_camera(24, 32, 0, torch.float32)
    background = torch.rand(1, 1, 1, 1).expand(1, 3, 24, 32)
    results = []
    for change in (lambda x: layout(x).contiguous(), layout):
        inputs = [change(getattr(gaussians, name)).requires_grad_() for name in FIELDS]
        image = GaussianRenderer()(Gaussians(*inputs), camera, change(background)).image
        results.append([image.detach(), *torch.autograd.grad(image.square().sum(), inputs)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    camera = PinholeCamera(layout(camera.intrinsics), layout(camera.extrinsics), camera.height, camera.width)
    image = GaussianRenderer()(Gaussians(*inputs), camera, background).image
    assert largest(image, results[0][0]) <= 1e-6
