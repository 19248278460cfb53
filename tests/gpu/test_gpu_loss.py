"""The photometric loss by Triton's kernels: Kornia's in float64."""

import pytest
import torch
from kornia.losses import ssim_loss

from kgs.losses import photometric_loss, target_moments


@pytest.mark.parametrize(
    ("shape", "weight"),
    [
        ((1, 1, 11, 11), 0.2),
        ((2, 3, 11, 17), 0.2),
        pytest.param((1, 3, 25, 12), 0.2, marks=pytest.mark.slow),
        pytest.param((1, 2, 13, 40), 3.0, marks=pytest.mark.slow),
    ],
)
def test_value_and_gradient_are_kornias(shape, weight):
    image, target = torch.rand(shape), torch.rand(shape)
    image[..., ::2, 3:5] = target[..., ::2, 3:5]  # no slope where they are equal
    leaf, exact = image.clone().requires_grad_(), image.double().requires_grad_()
    value = photometric_loss(leaf, target, weight, moments=target_moments(target), backend="triton")
    value.backward()
    expected = (exact - target).abs().mean() + 2 * weight * ssim_loss(exact, target.double(), 11)
    expected.backward()
    assert value.dtype == torch.float32
    assert value.shape == ()
    assert abs(value - expected) <= 1e-6 * expected
    assert (leaf.grad - exact.grad).abs().max() <= 2e-6 * exact.grad.abs().max()
    with torch.no_grad():
        assert torch.equal(photometric_loss(image, target, weight, backend="triton"), value)
