"""The photometric loss of each backend against Kornia's in float64: values, gradients, bits."""

import math
from functools import partial

import pytest
import torch
from kornia.losses import ssim_loss

from kgs.losses import photometric_loss, target_moments

SIZES = [(1, 1, 11, 11), (2, 3, 11, 17), (1, 3, 16, 11), (1, 2, 33, 129), (3, 1, 27, 12), (1, 4, 70, 43)]


@pytest.fixture(autouse=True)
def _many_pieces(kernel_backend, monkeypatch):
    """Small pictures in many pieces, as large ones are."""
    if kernel_backend == "numba":
        monkeypatch.setattr("kgs.backends.cpu.loss.MIN_PIXELS", 1)


def make_pair(shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(shape, generator=generator)
    return (target + 0.2 * torch.randn(shape, generator=generator)).clamp(0, 1), target


def value_and_gradient(image, target, weight=0.2, *, backend, **options):
    image = image.clone().requires_grad_()
    value = photometric_loss(image, target, weight, backend=backend, **options)
    value.backward()
    return value.detach(), image.grad


@pytest.fixture
def run(kernel_backend):
    """`value_and_gradient` by each backend beside torch."""
    return partial(value_and_gradient, backend=kernel_backend)


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("weight", [0.2, 3.0])
def test_value_and_gradient_are_kornias(run, shape, weight):
    image, target = make_pair(shape)
    value, gradient = run(image, target, weight)
    exact = image.double().requires_grad_()
    expected = (exact - target).abs().mean() + 2 * weight * ssim_loss(exact, target.double(), 11)
    expected.backward()
    assert value.dtype == torch.float32
    assert value.shape == ()
    assert abs(value - expected) <= 1e-6 * expected
    assert (gradient - exact.grad).abs().max() <= 2e-6 * exact.grad.abs().max()


@pytest.mark.parametrize("shape", SIZES)
def test_the_absolute_difference_has_no_slope_where_it_is_zero(run, shape):
    image, target = make_pair(shape)
    image[..., ::2, 3:] = target[..., ::2, 3:]
    for found, expected in zip(run(image, target, 1e-9), run(image, target, 0.0), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)


def test_bits_depend_neither_on_threads_nor_on_repetition(run, set_threads):
    image, target = make_pair((1, 3, 150, 131))
    found = []
    for threads in (1, 1, 2, 2, 3, 3, 4, 4):
        set_threads(threads)
        found.append(run(image, target, moments=target_moments(target)))
    assert all(torch.equal(value, found[0][0]) and torch.equal(grad, found[0][1]) for value, grad in found)


def test_a_graph_that_is_kept_gives_its_gradient_again(kernel_backend, run):
    image, target = make_pair((2, 3, 20, 24))
    image.requires_grad_()
    value = photometric_loss(image, target, backend=kernel_backend)
    first, second = (torch.autograd.grad(3 * value, image, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(first, second)
    torch.testing.assert_close(first, 3 * run(image.detach(), target)[1])


@pytest.mark.parametrize("graph", [True, False])
def test_images_without_a_gradient(kernel_backend, run, graph):
    image, target = make_pair((1, 3, 20, 24))
    with torch.set_grad_enabled(graph):
        value = photometric_loss(image, target, backend=kernel_backend)
    assert not value.requires_grad
    assert torch.equal(value, run(image, target)[0])


def test_nan_reaches_the_loss_and_the_gradient_around_it(run):
    image, target = make_pair((1, 1, 40, 40))
    image[0, 0, 20, 20] = math.nan
    value, gradient = run(image, target)
    assert value.isnan()
    assert torch.equal(gradient.isnan(), value_and_gradient(image, target, backend="torch")[1].isnan())


def test_torch_does_what_has_no_kernel(run):
    mask = torch.ones(16, 19)
    mask[:3] = 0
    for shape, options in (
        ((1, 3, 16, 19), {"mask": mask}),
        ((1, 3, 16, 19), {"fast": False}),
        ((1, 3, 16, 19), {"weight": 0.0}),
        ((1, 3, 10, 19), {}),
    ):
        pair = make_pair(shape)
        for found, expected in zip(
            run(*pair, **options), value_and_gradient(*pair, backend="torch", **options), strict=True
        ):
            assert torch.equal(found, expected)


def test_backends_by_name(kernel_backend):
    image, target = make_pair((1, 3, 16, 19))
    with pytest.raises(ValueError, match=f"backend: '{kernel_backend}' does not cover this call of loss"):
        photometric_loss(image.double(), target.double(), backend=kernel_backend)
    with pytest.raises(ValueError, match="^backend:"):
        photometric_loss(image, target, backend="cuda")
    assert torch.equal(photometric_loss(image, target), photometric_loss(image, target, backend=kernel_backend))
