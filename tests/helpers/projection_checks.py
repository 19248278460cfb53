"""What tests of projection have in common."""

import torch
from factories import FIELDS, batch, random_camera, random_gaussians, replace, staged
from kornia.geometry.camera import PinholeCamera
from targets import CPU, TORCH, move

from kgs import Gaussians, project

HEIGHT, WIDTH = 48, 64
PACKED = ("means2d", "factors", "depths", "radii", "opacities", "colors")


def scene(n=60, degree=1, dtype=torch.float64, cameras=1):
    views = [random_camera(HEIGHT, WIDTH, seed, dtype) for seed in range(cameras)]
    return random_gaussians(n, 0, dtype, degree, WIDTH), batch(*views)


def covariances(gaussians):
    """R S S R^T in float64 with R v = q v q* / |q|^2."""
    w, x, y, z = gaussians.quats.double().unbind(1)
    first = (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y))
    second = (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x))
    third = (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z)
    turn = torch.stack([*first, *second, *third], 1).reshape(-1, 3, 3)
    turn = turn / (w * w + x * x + y * y + z * z)[:, None, None]
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


def values_and_gradients(gaussians, cameras):
    leaves = {name: getattr(gaussians, name).clone().requires_grad_() for name in FIELDS}
    got = project(Gaussians(**leaves), cameras)
    (
        got.means2d.sum() + got.factors.square().sum() + got.depths.sum() + (got.opacities[:, None] * got.colors).sum()
    ).backward()
    return got, {name: leaf.grad for name, leaf in leaves.items()}


# -- kernels against torch -------------------------------------------------------------------------------------------

DIFFERENTIABLE = ("means2d", "factors", "depths", "opacities", "colors")


def wide_scene(degree=2, n=400, cameras=1):
    """Gaussians in and beside the image, before and behind the camera."""
    gaussians = random_gaussians(n, 3, torch.float32, degree, WIDTH)
    means = gaussians.means * torch.tensor([1.8, 1.8, 1.0])
    means[::5, 2] *= -1
    cameras = batch(*(random_camera(HEIGHT, WIDTH, seed, torch.float32) for seed in range(cameras)))
    return replace(gaussians, means=means), cameras


def list_and_gradients(gaussians, cameras, target=TORCH, dtype=torch.float32, wanted=FIELDS, **options):
    """The list, and the gradients of a sum of its values with random weights, both on the CPU.

    `wanted` are those of the fields, and of "extrinsics" and "intrinsics", that have a gradient.
    """
    matrices = {name: getattr(cameras, name) for name in ("extrinsics", "intrinsics")}
    inputs = {name: target.move(x, dtype).clone() for name, x in (vars(gaussians) | matrices).items()}
    for name in wanted:
        inputs[name].requires_grad_()
    height, width = target.move(cameras.height), target.move(cameras.width)
    seen = PinholeCamera(inputs["intrinsics"], inputs["extrinsics"], height, width)
    fields = Gaussians(*(inputs[name] for name in FIELDS))
    got = project(fields, seen, backend=target.backend, **staged(**options))
    values = [getattr(got, name) for name in DIFFERENTIABLE]
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x) for x in values]
    used = [(x, w) for x, w in zip(values, weights, strict=True) if x.requires_grad]
    torch.autograd.backward(*zip(*used, strict=True))
    grads = {name: None if x.grad is None else x.grad.cpu() for name, x in inputs.items()}
    graphs = {name: getattr(got, name).requires_grad for name in DIFFERENTIABLE}
    return move(got, CPU), grads, graphs


def assert_alike(gaussians, cameras, target, wanted=FIELDS, accuracy=3e-6, **options):
    """The list of torch in float32, and what torch says in float64."""
    got, grads, graphs = list_and_gradients(gaussians, cameras, target, wanted=wanted, **options)
    listed, same, same_graphs = list_and_gradients(gaussians, cameras, wanted=wanted, **options)
    exact, exact_grads, _ = list_and_gradients(gaussians, cameras, TORCH, torch.float64, wanted, **options)
    for name in ("camera_ids", "gaussian_ids", "num_nonfinite", "radii"):
        assert torch.equal(getattr(got, name), getattr(listed, name)), name
        assert getattr(got, name).dtype == getattr(listed, name).dtype
    assert (got.image_size, got.num_cameras, got.num_gaussians) == (exact.image_size, exact.num_cameras, len(gaussians))
    assert graphs == same_graphs
    assert {name for name, x in grads.items() if x is None} == {name for name, x in same.items() if x is None}
    pairs = [(name, getattr(got, name), getattr(exact, name)) for name in DIFFERENTIABLE]
    for name, x, y in pairs + [(name, x, exact_grads[name]) for name, x in grads.items() if x is not None]:
        assert x.shape == y.shape, name
        assert x.dtype == torch.float32
        assert x.numel() == 0 or (x - y).abs().max() <= accuracy * y.abs().max(), name
    return got, grads
