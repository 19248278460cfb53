"""Absolute gradients of the centres: against one backward pass for each pixel, and what takes them."""

from dataclasses import replace

import pytest
import torch
from factories import batch, random_camera, random_gaussians, staged
from targets import CPU, move

import kgs

HEIGHT, WIDTH = 10, 9  # tiles that are not full


def drawn(projected, features, backend, **options):
    """The image and transmittance of one render, the centres as a leaf."""
    centres = projected.means2d.detach().requires_grad_()
    out = kgs.composite(replace(projected, means2d=centres), features, backend=backend, **staged(**options))
    return centres, torch.cat([out.features, out.transmittance], 1)


def scene(dtype, width=3):
    gaussians = random_gaussians(40, 3, sh_degree=None, image_size=16)
    cameras = batch(*(random_camera(HEIGHT, WIDTH, seed) for seed in (1, 2)))
    projected = kgs.project(gaussians, cameras, backend="torch")
    generator = torch.Generator().manual_seed(5)
    features = torch.rand(len(projected), width, generator=generator, dtype=torch.float64)
    grads = torch.randn(2, width + 1, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    return [move(x, CPU, dtype) for x in (projected, features, grads)]


def test_sums_of_absolute_values_over_pixels():
    projected, features, grads = scene(torch.float64)
    total = torch.zeros_like(projected.means2d)
    for y in range(HEIGHT):
        for x in range(WIDTH):
            centres, image = drawn(projected, features, "torch")
            (image * grads)[:, :, y, x].sum().backward()
            total += centres.grad.abs()
    for dtype, bound in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
        for options in ({}, {"max_bytes": 2**16}):
            projected, features, grads = scene(dtype)
            centres, image = drawn(projected, features, "torch", absgrad=True, **options)
            (image * grads).sum().backward()
            assert (centres.absgrad - total).abs().max() < bound * total.max()
    assert (centres.grad.abs() <= centres.absgrad * (1 + 1e-5) + 1e-7).all()
    assert centres.grad.abs().sum() < 0.9 * centres.absgrad.sum()  # there is something to tell apart


def test_many_features_go_to_torch():
    projected, features, grads = scene(torch.float32, width=9)
    found = []
    for backend in ("auto", "torch"):
        centres, image = drawn(projected, features, backend, absgrad=True)
        (image * grads).sum().backward()
        found.append(centres.absgrad)
    assert torch.equal(*found)
    with pytest.raises(ValueError, match=r"backend: .*numba"):
        drawn(projected, features, "numba", absgrad=True)


def test_the_renderer_leaves_them_for_the_densifier():
    model = kgs.GaussianModel.from_points(torch.rand(50, 3) + torch.tensor([-0.5, -0.5, 2.0]), torch.rand(50, 3))
    optimizer = torch.optim.Adam(model.parameters())
    renderer = kgs.GaussianRenderer(absgrad=True)
    out = renderer(model(), random_camera(18, 13, 1, torch.float32))
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
    projected, features, grads = scene(torch.float32)
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
