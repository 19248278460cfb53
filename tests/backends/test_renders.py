"""What every render must show, on each backend and on a card: the dense reference in float64."""

import pytest
import torch
from compositing_checks import STOP, TH
from factories import FIELDS, OUTPUTS, random_camera, random_gaussians, random_scene
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from oracles import near_threshold
from targets import CARD, CPU, move

import kgs
import kgs.reference
from kgs import GaussianRenderer, backends

EXACT = {"alpha_threshold": 0.0, "transmittance_stop": 0.0}


@pytest.mark.parametrize("device", [pytest.param(torch.device("cuda"), marks=CARD)])
def test_auto_takes_the_kernels_of_a_card(device):
    """Else all tests of a card would pass in torch."""
    assert backends.get_backend("auto", device).name == "triton"


def against_reference(seed, dtype, thresholds, sh_degree, device, opacities=(0.05, 0.95)):
    """Largest image difference at certain and at doubtful pixels, share of the latter, relative gradient errors."""
    height, width, n = 40, 48, 80
    options = dict(zip(("alpha_threshold", "transmittance_stop"), thresholds, strict=True))
    gaussians = random_gaussians(n, seed, dtype, sh_degree, image_size=width, opacities=opacities)
    camera = random_camera(height, width, seed, dtype)
    doubtful = near_threshold(gaussians, camera, *thresholds)
    generator = torch.Generator().manual_seed(seed + 100)
    weights = torch.randn(3, height, width, generator=generator, dtype=torch.float64) * ~doubtful
    background = torch.rand(3, generator=generator, dtype=torch.float64).to(dtype)
    images, gradients = [], []
    for render, where in (
        (lambda *args: GaussianRenderer(**options)(*args).image, device),
        (lambda *args: kgs.reference.render(*args, **options), CPU),
    ):
        values = [*(getattr(gaussians, name) for name in FIELDS), camera.extrinsics, camera.intrinsics, background]
        inputs = [move(x, where).clone().requires_grad_() for x in values]
        view = PinholeCamera(inputs[6], inputs[5], camera.height.to(where), camera.width.to(where))
        image = render(kgs.Gaussians(*inputs[:5]), view, inputs[7])
        found = torch.autograd.grad((image[0].double() * weights.to(where)).sum(), inputs)
        images.append(move(image, CPU, torch.float64)[0])
        # the entries that make a camera: [R | t], and focal lengths, skew and centre
        found = [*found[:5], found[5][:, :3], found[6][:, :2, :3], found[7]]
        gradients.append([move(x, CPU, torch.float64) for x in found])
    difference = (images[0] - images[1]).abs().amax(0)
    errors = [((a - b).abs().max() / b.abs().max()).item() for a, b in zip(*gradients, strict=True)]
    at_doubtful = difference[doubtful].max().item() if doubtful.any() else 0.0
    return difference[~doubtful].max().item(), at_doubtful, doubtful.double().mean().item(), errors


BOUNDS = [(torch.float32, 5e-6, 1e-5), (torch.float64, 1e-10, 1e-10)]  # of images and of gradients


@pytest.mark.parametrize(("seed", "sh_degree"), [(0, None), (1, 3)])
@pytest.mark.parametrize(("dtype", "image_bound", "bound"), BOUNDS)
def test_exact_sum_is_the_reference(seed, dtype, image_bound, bound, sh_degree, each_device):
    error, _, _, gradient_errors = against_reference(seed, dtype, (0.0, 0.0), sh_degree, each_device)
    assert error <= image_bound
    assert max(gradient_errors) <= bound


# two clamped layers leave (1 - 0.99)^2 of the light, which is the stop: opacities above 1 are often in doubt
@pytest.mark.parametrize(("opacities", "maximum"), [((0.05, 0.95), 1e-3), ((0.6, 1.3), 1e-2)])
@pytest.mark.parametrize(("dtype", "image_bound", "bound"), BOUNDS)
def test_default_thresholds_are_the_reference_away_from_decisions(
    dtype, image_bound, bound, opacities, maximum, each_device
):
    share = []
    for seed in range(3):
        error, at_doubtful, doubtful, gradient_errors = against_reference(
            seed, dtype, (TH, STOP), 1, each_device, opacities
        )
        assert error <= image_bound
        assert at_doubtful <= 1e-2
        assert max(gradient_errors) <= bound
        share.append(doubtful)
    assert sum(share) / len(share) < maximum


def shortest_axes(gaussians, camera):
    """Towards the camera, one by one."""
    pose, found = camera.extrinsics[0].double(), []
    centre = -pose[:3, :3].T @ pose[:3, 3]
    values = (getattr(gaussians, name).double() for name in ("means", "quats", "scales"))
    for mean, quat, scales in zip(*values, strict=True):
        axis = quaternion_to_rotation_matrix((quat / quat.norm())[None])[0][:, int(scales.argmin())]
        found.append(axis if axis @ (centre - mean) > 0 else -axis)
    return torch.stack(found)


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-5), (torch.float64, 1e-11)])
def test_alpha_depths_and_normals_are_what_the_reference_weights_say(dtype, bound, each_device):
    gaussians, camera = random_gaussians(25, 1, dtype, image_size=160), random_camera(24, 32, 1, dtype)
    there = (move(x, each_device) for x in (gaussians, camera))
    out = GaussianRenderer(**EXACT)(*there, outputs=("alpha", "depth", "median_depth", "normal"))
    assert out.image is None
    assert (out.normal.dtype, out.normal.device.type) == (dtype, each_device.type)
    got_alpha, depth, median = (getattr(out, name)[0, 0].cpu() for name in ("alpha", "depth", "median_depth"))
    layers = kgs.reference.layers(gaussians, camera, **EXACT)
    alpha = 1 - layers.transmittance  # rounded near 1, which is what divides the sum
    assert (got_alpha - alpha).abs().max() <= bound
    normal = torch.einsum("lhw,lc->chw", layers.weights, shortest_axes(gaussians, camera)[layers.order])
    assert (out.normal[0].cpu() - normal).abs().max() <= bound
    weighted = torch.einsum("lhw,l->hw", layers.weights, layers.depths)
    assert (alpha < 1e-3).any()
    assert ((depth * alpha - weighted).abs() * (alpha > 1.1e-6)).max() <= 10 * bound
    assert not depth[alpha < 0.9e-6].any()
    light = 1 - torch.cumsum(layers.weights, 0)
    expected = torch.where((light < 0.5).any(0), layers.depths[(light < 0.5).double().argmax(0)], 0.0)
    certain = ((light - 0.5).abs() > 1e-5).all(0)
    assert ((median - expected).abs() * certain).max() <= bound


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_each_output_alone_is_the_joint_one_and_the_others_are_none(dtype, each_device):
    gaussians, camera = (move(x, each_device) for x in random_scene(0, dtype, 80, (24, 33)))
    renderer = GaussianRenderer()
    joint = renderer(gaussians, camera, outputs=(*OUTPUTS, "normal"))
    for name in OUTPUTS:
        alone = renderer(gaussians, camera, outputs=(name,))
        assert torch.equal(getattr(alone, name), getattr(joint, name)), name
        assert all(getattr(alone, other) is None for other in OUTPUTS if other != name)
        assert getattr(alone, name).shape == (1, 3 if name == "image" else 1, 24, 33)
        assert getattr(alone, name).dtype == dtype
    assert renderer(gaussians, camera).alpha is None
    assert renderer(gaussians, camera, outputs=["depth"]).projected.colors.shape[1] == 0
