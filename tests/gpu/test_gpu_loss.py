"""What the loss of the kernels adds up and scales."""

import torch

from kgs.backends.gpu import loss
from kgs.losses import photometric_loss


def test_sums_of_many_blocks_and_a_scaled_gradient(monkeypatch):
    monkeypatch.setattr(loss, "_SUMS", 2)  # of 7 blocks
    image, target = torch.rand(1, 2, 25, 32, requires_grad=True), torch.rand(1, 2, 25, 32)
    found = []
    for backend in ("triton", "torch"):
        value = photometric_loss(image, target, 0.7, backend=backend)
        found.append((value.detach(), *torch.autograd.grad(-3 * value, image)))
    torch.testing.assert_close(*found, rtol=2e-6, atol=1e-8)
