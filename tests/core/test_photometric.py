"""The photometric loss against Kornia's own `ssim_loss`, differentiated by autograd."""

import math

import pytest
import torch
import torch.nn.functional as F
from factories import other_defaults
from kornia.losses import ssim_loss

from kgs.losses import photometric_loss, target_moments

pytestmark = pytest.mark.usefixtures("each_backend")

SIZES = [(1, 3, 45, 67), (1, 3, 11, 11), (2, 3, 12, 31), (1, 1, 64, 11), (3, 4, 20, 20)]


def make_pair(shape, kind="noise", dtype=torch.float32):
    generator = torch.Generator().manual_seed(sum(shape))
    target = torch.rand(shape, generator=generator)
    if kind == "bright":
        target = 0.9 + 0.05 * target
    elif kind == "dark":
        target = 0.02 * target
    elif kind == "edges":
        ramp = torch.linspace(0, 1, shape[-1]).expand(shape)
        target = 0.5 * (torch.sin(17 * ramp) > 0) + 0.3 * ramp.flip(-1)
    image = (target + 0.05 * torch.randn(shape, generator=generator)).clamp(0, 1)
    return image.to(dtype), target.to(dtype)


def kornia_loss(image, target, weight):
    return (image - target).abs().mean() + 2 * weight * ssim_loss(image, target, 11)


def value_and_gradient(loss, image):
    image = image.clone().requires_grad_()
    value = loss(image)
    value.backward()
    return value.detach(), image.grad


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("kind", ["noise", "bright", "dark", "edges"])
def test_fast_path_is_as_accurate_as_kornia(shape, kind):
    # Variances of bright, flat regions cancel: there Kornia's own float32 gradient is off by up to 1e-4 of the largest.
    image, target = make_pair(shape, kind)
    value, gradient = value_and_gradient(lambda x: photometric_loss(x, target, 1.0), image)
    kornia_value, kornia_gradient = value_and_gradient(lambda x: kornia_loss(x, target, 1.0), image)
    exact_value, exact = value_and_gradient(lambda x: kornia_loss(x, target.double(), 1.0), image.double())
    assert abs(value - exact_value) <= max(1e-6, 2 * abs(kornia_value - exact_value))
    kornia_error = (kornia_gradient - exact).abs().max()
    assert (gradient - exact).abs().max() <= max(1e-5 * exact.abs().max(), 2 * kornia_error)


@pytest.mark.parametrize("shape", [(1, 3, 64, 64), (2, 3, 45, 67)])
@pytest.mark.parametrize("kind", ["flat", "bright"])
@pytest.mark.parametrize("apart", [0.0, 1e-7, 1e-6])
def test_nearly_equal_images_have_no_negative_loss(shape, kind, apart):
    target = torch.full(shape, 0.9) if kind == "flat" else make_pair(shape, "bright")[1]
    image = target + apart
    mask = torch.ones(shape[-2:])
    mask[:20] = 0
    l1 = float((image - target).abs().mean())
    for options in ({}, {"mask": mask}, {"moments": target_moments(target)}):
        assert float(photometric_loss(image, target, 1.0, **options)) >= 0.99 * l1
    image[0, 0, 30, 30] = math.nan
    assert photometric_loss(image, target, 1.0).isnan()


def test_gradient_of_black_images_keeps_kornias_eps():
    image, target = torch.full((1, 3, 16, 16), 1e-4), torch.zeros(1, 3, 16, 16)
    value, gradient = value_and_gradient(lambda x: photometric_loss(x, target, 1.0), image)
    expected, expected_gradient = value_and_gradient(lambda x: kornia_loss(x, target.double(), 1.0), image.double())
    assert abs(value - expected) <= 1e-6
    torch.testing.assert_close(gradient.double(), expected_gradient, rtol=1e-5, atol=0)


def test_cached_moments_change_no_bit_and_several_losses_before_a_backward_do_not_mix():
    pairs = [make_pair((1, 3, 20, 24), kind) for kind in ("noise", "bright")]
    alone = [value_and_gradient(lambda x, t=target: photometric_loss(x, t), image) for image, target in pairs]
    moments = [target_moments(target) for _, target in pairs]
    images = [image.clone().requires_grad_() for image, _ in pairs]
    losses = [
        photometric_loss(image, target, moments=cached)
        for image, (_, target), cached in zip(images, pairs, moments, strict=True)
    ]
    (3 * (losses[0] + losses[1])).backward()
    for image, loss, (value, gradient) in zip(images, losses, alone, strict=True):
        assert torch.equal(loss, value)
        torch.testing.assert_close(image.grad, 3 * gradient)  # the gradient from above scales it


def test_weight_zero_is_plain_l1_at_any_size():
    image, target = torch.tensor([[[[0.25, 0.5]]]]), torch.tensor([[[[0.75, 0.25]]]])
    assert photometric_loss(image, target, 0.0).item() == 0.375


def test_small_images_take_kornias_path():
    image, target = make_pair((1, 3, 7, 10))
    value, gradient = value_and_gradient(lambda x: photometric_loss(x, target), image)
    expected, expected_gradient = value_and_gradient(lambda x: kornia_loss(x, target, 0.2), image)
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(gradient, expected_gradient)


def test_gradient_reaches_a_target_that_asks_for_it():
    image, target = make_pair((1, 1, 12, 12), dtype=torch.float64)
    for dtype in (torch.float32, torch.float64):
        reached = target.to(dtype, copy=True).requires_grad_()
        photometric_loss(image.to(dtype), reached).backward()
        _, expected = value_and_gradient(lambda y, x=image: kornia_loss(x, y, 0.2), target)
        torch.testing.assert_close(reached.grad.double(), expected, rtol=1e-4, atol=1e-8)


@pytest.mark.usefixtures("torch_alone")
def test_float64_passes_gradcheck_twice():
    image, target = make_pair((1, 1, 6, 7), dtype=torch.float64)
    image.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: photometric_loss(x, target), image)
    assert torch.autograd.gradgradcheck(lambda x: photometric_loss(x, target), image)


def test_second_derivative_through_the_fast_path_is_refused():
    image, target = make_pair((1, 3, 16, 16))
    image.requires_grad_()
    with pytest.raises(RuntimeError, match="fast=False"):
        torch.autograd.grad(photometric_loss(image, target), image, create_graph=True)
    (gradient,) = torch.autograd.grad(photometric_loss(image, target, fast=False), image, create_graph=True)
    gradient.square().sum().backward()
    assert image.grad.abs().max() > 0


def test_images_in_another_memory_layout_give_the_same():
    image, target = make_pair((2, 3, 16, 18))
    found = []
    for layout in (torch.contiguous_format, torch.channels_last):
        other = target.contiguous(memory_format=layout)
        found.append(
            value_and_gradient(lambda x, y=other: photometric_loss(x, y), image.contiguous(memory_format=layout))
        )
    torch.testing.assert_close(found[1], found[0])


def under_autocast(image, target, mask):
    with torch.autocast("cpu", dtype=torch.bfloat16):
        return value_and_gradient(lambda x: photometric_loss(x, target, mask=mask), image)


def under_other_defaults(image, target, mask):
    with other_defaults():
        return value_and_gradient(lambda x: photometric_loss(x, target, mask=mask), image)


def with_moments_of_inference_mode(image, target, mask):
    with torch.inference_mode():
        there = target.clone()
        moments = target_moments(there)
    return value_and_gradient(lambda x: photometric_loss(x, there, moments=moments, mask=mask), image)


def with_moments_for_the_target(image, target, mask):
    return value_and_gradient(lambda x: photometric_loss(x, target_moments(target), mask=mask), image)


WAYS = [under_autocast, under_other_defaults, with_moments_of_inference_mode, with_moments_for_the_target]


@pytest.mark.parametrize("mask", [None, torch.ones(32, 32).tril(8)], ids=["whole", "masked"])
@pytest.mark.parametrize("way", WAYS)
def test_the_loss_has_the_same_bits(way, mask):
    image, target = make_pair((2, 3, 32, 32))
    expected, expected_gradient = value_and_gradient(lambda x: photometric_loss(x, target, mask=mask), image)
    value, gradient = way(image, target, mask)
    assert torch.equal(value, expected)
    assert torch.equal(gradient, expected_gradient)


@pytest.mark.parametrize("kind", ["noise", "bright", "dark", "edges"])
@pytest.mark.parametrize("shape", [(1, 3, 11, 11), (2, 3, 45, 67)])
def test_moments_of_any_backend_are_as_exact_as_torchs(shape, kind):
    target = make_pair(shape, kind)[1]
    exact = target_moments(target.double())
    found, of_torch = (target_moments(target, backend=name) for name in ("auto", "torch"))
    for name in ("mean", "variance", "padded"):
        bound = 2 * float((getattr(of_torch, name) - getattr(exact, name)).abs().max()) + 1e-9
        assert float((getattr(found, name) - getattr(exact, name)).abs().max()) <= bound


# -- masks -----------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("one_per_image", [False, True])
@pytest.mark.parametrize(("dtype", "fast"), [(torch.float64, True), (torch.float32, True), (torch.float32, False)])
def test_value_and_gradient_are_those_of_the_definition(dtype, fast, one_per_image):
    image, target = make()
    mask = round_mask()
    if one_per_image:
        mask = torch.stack([mask, round_mask(radius=9.1)])[:, None]
    expected, expected_gradient = value_and_gradient(lambda x: by_windows(x, target, mask, 0.7), image)
    image, target = image.to(dtype), target.to(dtype)
    cached = target_moments(target)
    tolerance = 1e-12 if dtype == torch.float64 else 2e-6
    for options in ({}, {"moments": cached}):
        value, found = value_and_gradient(
            lambda x, o=options: photometric_loss(x, target, 0.7, mask=mask, fast=fast, **o), image
        )
        assert abs(value - expected) <= tolerance
        assert (found - expected_gradient).abs().max() <= 5 * tolerance * expected_gradient.abs().max()
    assert not found[~mask.expand(2, 1, 16, 19).expand_as(found)].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_mask_of_every_pixel_is_no_mask(dtype):
    image, target = make(dtype=dtype)
    expected, expected_gradient = value_and_gradient(lambda x: photometric_loss(x, target), image)
    whole = torch.ones(16, 19)
    for mask in (whole.byte(), whole.double(), whole.bool().expand(1, 16, 19), whole.expand(2, 1, 16, 19)):
        value, found = value_and_gradient(lambda x, m=mask: photometric_loss(x, target, mask=m), image)
        torch.testing.assert_close(value, expected)
        torch.testing.assert_close(found, expected_gradient)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30])
def test_what_is_outside_does_not_matter_whatever_it_is(dtype, value):
    (image, target), mask = make(dtype=dtype), round_mask()
    expected, expected_gradient = value_and_gradient(lambda x: photometric_loss(x, target, mask=mask), image)
    image, target = (x.masked_fill(~mask, value) for x in (image, target))
    for moments in (None, target_moments(target)):
        found = value_and_gradient(lambda x, m=moments: photometric_loss(x, target, mask=mask, moments=m), image)
        torch.testing.assert_close(found[0], expected)
        torch.testing.assert_close(found[1], expected_gradient)


def test_where_no_window_is_whole_the_first_term_is_left():
    (image, target), mask = make((1, 3, 30, 30)), torch.zeros(30, 30, dtype=torch.bool)
    mask[10:18, 10:18] = True
    expected = (image - target).abs()[..., 10:18, 10:18].mean()
    for dssim_weight in (0.0, 0.5):
        torch.testing.assert_close(photometric_loss(image, target, dssim_weight, mask=mask), expected)
