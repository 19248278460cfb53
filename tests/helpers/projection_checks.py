"""What tests of projection have in common."""

import torch
from factories import FIELDS, batch, leaves, random_camera, random_gaussians, replace, staged

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


# -- one backend against another -----------------------------------------------------------------------------------

DIFFERENTIABLE = ("means2d", "factors", "depths", "opacities", "colors")


def wide_scene(degree=2, n=400, cameras=1):
    """Gaussians in and beside the image, before and behind the camera."""
    gaussians = random_gaussians(n, 3, torch.float32, degree, WIDTH)
    means = gaussians.means * torch.tensor([1.8, 1.8, 1.0])
    means[::5, 2] *= -1
    cameras = batch(*(random_camera(HEIGHT, WIDTH, seed, torch.float32) for seed in range(cameras)))
    return replace(gaussians, means=means), cameras


def list_and_gradients(gaussians, cameras, backend, dtype=torch.float32, **options):
    """The list, and the gradients of a sum of its values with random weights."""
    gaussians, inputs = leaves(gaussians.to(dtype))
    cameras = type(cameras)(
        *(x.to(dtype) for x in (cameras.intrinsics, cameras.extrinsics)), cameras.height, cameras.width
    )
    got = project(gaussians, cameras, backend=backend, **staged(**options))
    fields = [getattr(got, name) for name in DIFFERENTIABLE]
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(x.shape, generator=generator, dtype=torch.float64).to(dtype) for x in fields]
    used = [(x, w) for x, w in zip(fields, weights, strict=True) if x.requires_grad]
    torch.autograd.backward(*zip(*used, strict=True))
    return got, dict(zip(FIELDS, (x.grad for x in inputs), strict=True))


def assert_alike(gaussians, cameras, backend, accuracy=3e-6, **options):
    """The list of torch in float32, and what torch says in float64."""
    got, grads = list_and_gradients(gaussians, cameras, backend, **options)
    listed, same = list_and_gradients(gaussians, cameras, "torch", **options)
    exact, exact_grads = list_and_gradients(gaussians, cameras, "torch", torch.float64, **options)
    for name in ("camera_ids", "gaussian_ids", "num_nonfinite", "radii"):
        assert torch.equal(getattr(got, name), getattr(listed, name)), name
        assert getattr(got, name).dtype == getattr(listed, name).dtype
    assert (got.image_size, got.num_cameras, got.num_gaussians) == (exact.image_size, exact.num_cameras, len(gaussians))
    pairs = [(name, getattr(got, name), getattr(exact, name)) for name in DIFFERENTIABLE]
    for name, x, y in pairs + [(name, grads[name], exact_grads[name]) for name in FIELDS]:
        if y is None:
            assert x is None, name
            continue
        assert x.shape == y.shape, name
        assert x.dtype == torch.float32
        assert x.numel() == 0 or (x - y).abs().max() <= accuracy * y.abs().max(), name
    assert [getattr(got, n).requires_grad for n in DIFFERENTIABLE] == [
        getattr(listed, n).requires_grad for n in DIFFERENTIABLE
    ]
    assert [grads[name] is None for name in FIELDS] == [same[name] is None for name in FIELDS]
    return got, grads


def assert_camera_gradients(gaussians, cameras, backend, wanted):
    """Gradients of "pose", "lens" and "Gaussians", as far as they are wanted: what torch says in float64."""
    found = []
    for name, dtype in ((backend, torch.float32), ("torch", torch.float64)):
        matrices = {"pose": cameras.extrinsics, "lens": cameras.intrinsics}
        leaf = {part: x.to(dtype).clone().requires_grad_(part in wanted) for part, x in matrices.items()}
        values, inputs = leaves(gaussians.to(dtype)) if "Gaussians" in wanted else (gaussians.to(dtype), [])
        seen = type(cameras)(leaf["lens"], leaf["pose"], cameras.height, cameras.width)
        fields = [getattr(project(values, seen, backend=name), field) for field in DIFFERENTIABLE]
        generator = torch.Generator().manual_seed(2)
        weights = [torch.randn(x.shape, generator=generator, dtype=torch.float64).to(dtype) for x in fields]
        used = [(x, w) for x, w in zip(fields, weights, strict=True) if x.requires_grad]
        torch.autograd.backward(*zip(*used, strict=True))
        found.append(([x.requires_grad for x in fields], [x.grad for x in (*leaf.values(), *inputs)]))
    assert found[0][0] == found[1][0]
    for got, exact in zip(found[0][1], found[1][1], strict=True):
        assert (got is None) == (exact is None)
        assert got is None or (got - exact).abs().max() <= 3e-6 * exact.abs().max()
