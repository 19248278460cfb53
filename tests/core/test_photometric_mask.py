"""The photometric loss of some pixels alone, against sums over windows made one pixel at a time."""

import math

import pytest
import torch
import torch.nn.functional as F

from kgs.losses import photometric_loss, target_moments


def make(shape=(2, 3, 16, 19), dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(shape, generator=generator, dtype=torch.float64)
    image = (target + 0.2 * torch.randn(shape, generator=generator, dtype=torch.float64)).clamp(0, 1)
    return image.to(dtype), target.to(dtype)


def round_mask(height=16, width=19, radius=7.6):
    """A disc that reaches over the left border, with a hole."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    mask = (y - 8) ** 2 + (x - 5) ** 2 <= radius**2
    mask[14, 9] = False
    return mask


def by_windows(image, target, mask, weight):
    """The definition: mean over masked pixels, mean over the windows that lie in the mask; 121 taps for each pixel."""
    (b, _, h, w), inside = image.shape, mask.expand(image.shape[0], 1, *mask.shape[-2:])
    l1 = (image - target).abs()[inside.expand_as(image)].mean()
    taps = torch.exp(-((torch.arange(11.0, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    taps = (taps / taps.sum()).outer(taps / taps.sum()).reshape(1, 1, 121, 1)

    def patches(x):
        return F.unfold(F.pad(x, [5] * 4, mode="reflect"), 11).reshape(b, -1, 121, h * w)

    x, y = patches(image), patches(target)
    mx, my = (x * taps).sum(2), (y * taps).sum(2)
    vx, vy, vxy = (x * x * taps).sum(2) - mx**2, (y * y * taps).sum(2) - my**2, (x * y * taps).sum(2) - mx * my
    ssim = (2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4) + 1e-12)
    whole = patches(inside.double()).amin(2) > 0
    assert 0 < whole.sum() < whole.numel()
    return l1 + weight * (1 - ssim[whole.expand_as(ssim)].mean())


def gradient(loss, image):
    image = image.clone().requires_grad_()
    value = loss(image)
    value.backward()
    return value.detach(), image.grad


@pytest.mark.usefixtures("each_backend")
@pytest.mark.parametrize("one_per_image", [False, True])
@pytest.mark.parametrize(("dtype", "fast"), [(torch.float64, True), (torch.float32, True), (torch.float32, False)])
def test_value_and_gradient_are_those_of_the_definition(dtype, fast, one_per_image):
    image, target = make()
    mask = round_mask()
    if one_per_image:
        mask = torch.stack([mask, round_mask(radius=9.1)])[:, None]
    expected, expected_gradient = gradient(lambda x: by_windows(x, target, mask, 0.7), image)
    image, target = image.to(dtype), target.to(dtype)
    cached = target_moments(target)
    tolerance = 1e-12 if dtype == torch.float64 else 2e-6
    for options in ({}, {"moments": cached}):
        value, found = gradient(lambda x, o=options: photometric_loss(x, target, 0.7, mask=mask, fast=fast, **o), image)
        assert abs(value - expected) <= tolerance
        assert (found - expected_gradient).abs().max() <= 5 * tolerance * expected_gradient.abs().max()
    assert not found[~mask.expand(2, 1, 16, 19).expand_as(found)].any()


@pytest.mark.usefixtures("each_backend")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_mask_of_every_pixel_is_no_mask(dtype):
    image, target = make(dtype=dtype)
    expected, expected_gradient = gradient(lambda x: photometric_loss(x, target), image)
    whole = torch.ones(16, 19)
    for mask in (whole.byte(), whole.double(), whole.bool().expand(1, 16, 19), whole.expand(2, 1, 16, 19)):
        value, found = gradient(lambda x, m=mask: photometric_loss(x, target, mask=m), image)
        torch.testing.assert_close(value, expected)
        torch.testing.assert_close(found, expected_gradient)


@pytest.mark.usefixtures("each_backend")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30])
def test_what_is_outside_does_not_matter_whatever_it_is(dtype, value):
    (image, target), mask = make(dtype=dtype), round_mask()
    expected, expected_gradient = gradient(lambda x: photometric_loss(x, target, mask=mask), image)
    image, target = (x.masked_fill(~mask, value) for x in (image, target))
    for moments in (None, target_moments(target)):
        found = gradient(lambda x, m=moments: photometric_loss(x, target, mask=mask, moments=m), image)
        torch.testing.assert_close(found[0], expected)
        torch.testing.assert_close(found[1], expected_gradient)


def test_where_no_window_is_whole_the_first_term_is_left():
    (image, target), mask = make((1, 3, 30, 30)), torch.zeros(30, 30, dtype=torch.bool)
    mask[10:18, 10:18] = True
    expected = (image - target).abs()[..., 10:18, 10:18].mean()
    for dssim_weight in (0.0, 0.5):
        torch.testing.assert_close(photometric_loss(image, target, dssim_weight, mask=mask), expected)
