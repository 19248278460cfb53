"""Absolute gradients of the centres: against one backward pass for each pixel, on every backend."""

from dataclasses import replace

import pytest
import torch
from factories import batch, random_camera, random_gaussians, staged

import kgs

HEIGHT, WIDTH = 18, 13  # tiles that are not full


def drawn(projected, features, backend, **options):
    """The image and transmittance of one render, the centres as a leaf."""
    centres = projected.means2d.detach().requires_grad_()
    out = kgs.composite(replace(projected, means2d=centres), features, backend=backend, **staged(**options))
    return centres, torch.cat([out.features, out.transmittance], 1)


def scene(dtype, width=3):
    gaussians = random_gaussians(40, 3, sh_degree=None)
    cameras = batch(*(random_camera(HEIGHT, WIDTH, seed) for seed in (1, 2)))
    projected = kgs.project(gaussians, cameras, backend="torch")
    names = ("means2d", "factors", "opacities", "depths", "colors")
    projected = replace(projected, **{name: getattr(projected, name).detach().to(dtype) for name in names})
    generator = torch.Generator().manual_seed(5)
    features = torch.rand(len(projected), width, generator=generator, dtype=torch.float64).to(dtype)
    grads = torch.randn(2, width + 1, HEIGHT, WIDTH, generator=generator, dtype=torch.float64).to(dtype)
    return projected, features, grads


@pytest.fixture(scope="module")
def by_pixel():
    """What is expected of `scene`: the sum of the absolute gradients of its pixels, one backward pass for each."""
    projected, features, grads = scene(torch.float64)
    total = torch.zeros_like(projected.means2d)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            centres, image = drawn(projected, features, "torch")
            (image * grads)[:, :, y, x].sum().backward()
            total += centres.grad.abs()
    return total


@pytest.mark.parametrize(
    ("backend", "dtype", "bound"),
    [("torch", torch.float64, 1e-12), ("torch", torch.float32, 1e-5), ("numba", torch.float32, 1e-5)],
)
@pytest.mark.parametrize("options", [{}, {"max_bytes": 2**16}], ids=["whole", "slices"])
def test_sums_of_absolute_values_over_pixels(backend, dtype, bound, options, by_pixel):
    projected, features, grads = scene(dtype)
    centres, image = drawn(projected, features, backend, absgrad=True, **options)
    (image * grads).sum().backward()
    assert (centres.absgrad - by_pixel).abs().max() < bound * by_pixel.max()
    assert (centres.grad.abs() <= centres.absgrad * (1 + 1e-5) + 1e-7).all()
    assert centres.grad.abs().sum() < 0.9 * centres.absgrad.sum()  # there is something to tell apart


def test_gradients_are_the_same_with_and_without():
    for backend in ("torch", "numba"):
        projected, features, grads = scene(torch.float32)
        found = []
        for absgrad in (False, True):
            centres, image = drawn(projected, features, backend, absgrad=absgrad)
            (image * grads).sum().backward()
            found.append(centres)
        assert torch.equal(found[0].grad, found[1].grad)
        assert not hasattr(found[0], "absgrad")


def test_many_features_go_to_torch():
    projected, features, grads = scene(torch.float32, width=9)
    centres, image = drawn(projected, features, "auto", absgrad=True)
    (image * grads).sum().backward()
    expected, image = drawn(projected, features, "torch", absgrad=True)
    (image * grads).sum().backward()
    assert torch.equal(centres.absgrad, expected.absgrad)
    with pytest.raises(ValueError, match=r"backend: .*numba"):
        drawn(projected, features, "numba", absgrad=True)


def test_the_renderer_leaves_them_for_the_densifier():
    model = kgs.GaussianModel.from_points(torch.rand(50, 3) + torch.tensor([-0.5, -0.5, 2.0]), torch.rand(50, 3))
    optimizer = torch.optim.Adam(model.parameters())
    renderer = kgs.GaussianRenderer(absgrad=True)
    out = renderer(model(), random_camera(HEIGHT, WIDTH, 1, torch.float32))
    out.projected.means2d.retain_grad()
    out.image.square().sum().backward()
    assert (out.projected.means2d.absgrad >= out.projected.means2d.grad.abs() - 1e-6).all()
    usual, absolute = (kgs.Densifier(model, optimizer, 1.0, absgrad=absgrad) for absgrad in (False, True))
    for densifier in (usual, absolute):
        densifier.observe(out.projected)
    assert (absolute.mean_gradients >= usual.mean_gradients - 1e-6).all()
    assert absolute.mean_gradients.sum() > 1.1 * usual.mean_gradients.sum()


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_graphs_that_keep_their_tensors_elsewhere_have_them_too(backend):
    projected, features, grads = (scene(torch.float32)[i] for i in range(3))
    plain, image = drawn(projected, features, backend, absgrad=True)
    image.backward(grads)
    with torch.autograd.graph.save_on_cpu():
        saved, image = drawn(projected, features, backend, absgrad=True)
        image.backward(grads)
    assert torch.equal(saved.absgrad, plain.absgrad)
    again = []

    def draw():
        centres, image = drawn(projected, features, backend, absgrad=True)
        again.append(centres)
        return image

    torch.utils.checkpoint.checkpoint(draw, use_reentrant=False).backward(grads)
    assert torch.equal(again[0].absgrad, plain.absgrad)
