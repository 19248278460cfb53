"""The photometric loss of kernels against Kornia's in float64: values, gradients, bits."""

import math

import torch
from targets import SELDOM_INTERPRETED, TORCH, Target

from kgs.losses import photometric_loss


def make_pair(shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(shape, generator=generator)
    return (target + 0.2 * torch.randn(shape, generator=generator)).clamp(0, 1), target


def value_and_gradient(target, pair, weight=0.2, mask=None, **options):
    """By a backend, on the CPU."""
    image, photo = (target.move(x) for x in pair)
    image = image.clone().requires_grad_()
    mask = None if mask is None else target.move(mask)
    value = photometric_loss(image, photo, weight, mask=mask, backend=target.backend, **options)
    value.backward()
    return value.detach().cpu(), image.grad.cpu()


@SELDOM_INTERPRETED
def test_bits_depend_neither_on_threads_nor_on_repetition(kernels, set_threads):
    pair = make_pair((1, 3, 20, 24) if kernels.interpreted else (1, 3, 150, 131))
    found = []
    for threads in (1, 1, 2, 3, 4):
        set_threads(threads)
        found.append(value_and_gradient(kernels, pair))
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other, strict=True))


def test_a_graph_that_is_kept_and_images_without_a_gradient(kernels):
    pair = make_pair((1, 2, 11, 13))
    image, target = (kernels.move(x) for x in pair)
    value, gradient = value_and_gradient(kernels, pair)
    for graph in (True, False):
        with torch.set_grad_enabled(graph):
            alone = photometric_loss(image, target, backend=kernels.backend)
        assert not alone.requires_grad
        assert torch.equal(alone.cpu(), value)
    loss = 3 * photometric_loss(image.requires_grad_(), target, backend=kernels.backend)
    first, second = (torch.autograd.grad(loss, image, retain_graph=True)[0].cpu() for _ in range(2))
    assert torch.equal(first, second)
    torch.testing.assert_close(first, 3 * gradient)


@SELDOM_INTERPRETED
def test_nan_reaches_the_loss_and_the_gradient_around_it(kernels):
    image, target = make_pair((1, 1, 40, 40))
    image[0, 0, 20, 20] = math.nan
    value, gradient = value_and_gradient(kernels, (image, target))
    assert value.isnan()
    assert torch.equal(gradient.isnan(), value_and_gradient(TORCH, (image, target))[1].isnan())


def test_torch_does_what_has_no_kernel(kernels):
    mask = torch.ones(16, 19)
    mask[:3] = 0
    for height, options in ((16, {"mask": mask}), (16, {"fast": False}), (16, {"weight": 0.0}), (10, {})):
        pair = make_pair((1, 3, height, 19))
        found = value_and_gradient(kernels, pair, **options)
        expected = value_and_gradient(Target("torch", kernels.device), pair, **options)
        assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
