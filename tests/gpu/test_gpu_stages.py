"""What only Triton's stages of activation, blending and loss have, beside `test_backend_matches_reference`."""

import math

import pytest
import torch
from factories import random_model

from kgs.backends.gpu import loss
from kgs.backends.gpu.blending import blend
from kgs.losses import photometric_loss


def test_scales_that_overflow_opacities_of_0_and_1_and_what_is_not_a_number():
    model = random_model(8, 0)
    edge = torch.tensor(math.log(torch.finfo(torch.float32).max))
    with torch.no_grad():
        model.log_scales[0] = torch.tensor([100.0, -math.inf, math.inf])
        model.log_scales[1] = torch.stack([edge, edge.nextafter(torch.tensor(0.0)), edge + 1])
        model.log_scales[2] = torch.tensor([-87.0, -200.0, 88.7])
        model.log_scales[3, 1] = math.nan
        model.opacity_logits[:5] = torch.tensor([math.inf, -math.inf, 200.0, -200.0, math.nan])
    weights = torch.rand(8, 3)
    found = []
    for backend in ("triton", "torch"):
        gaussians = model(backend=backend)
        outputs, inputs = (gaussians.scales, gaussians.opacities), (model.log_scales, model.opacity_logits)
        found.append((*outputs, *torch.autograd.grad(outputs, inputs, (weights, weights[:, 0]))))
    torch.testing.assert_close(*found, rtol=2e-6, atol=1e-37, equal_nan=True)
    assert not found[0][2][0].any()


def test_there_is_no_second_derivative():
    model = random_model(8)
    image, transmittance = torch.rand(1, 3, 5, 7, requires_grad=True), torch.rand(1, 1, 5, 7)
    blended = blend(image, transmittance, torch.rand(3, 1, 1))
    assert torch.equal(torch.autograd.grad(blended.sum(), image, retain_graph=True)[0], torch.ones_like(image))
    scales = model(backend="triton").scales
    for name, output, value in (("model", scales, model.log_scales), ("background", blended, image)):
        with pytest.raises(RuntimeError, match=f"{name}: expected backward without create_graph"):
            torch.autograd.grad(output.sum(), value, create_graph=True)


def test_the_gradient_of_a_background_is_torchs():
    color = torch.rand(3, 1, 1, requires_grad=True)
    blend(torch.rand(1, 3, 5, 7), torch.rand(1, 1, 5, 7), color).sum().backward()
    assert color.grad.all()


def test_a_loss_of_many_blocks_and_its_scaled_gradient(monkeypatch):
    monkeypatch.setattr(loss, "_SUMS", 2)  # of 7 blocks
    image, target = torch.rand(1, 2, 25, 32, requires_grad=True), torch.rand(1, 2, 25, 32)
    found = []
    for backend in ("triton", "torch"):
        value = photometric_loss(image, target, 0.7, backend=backend)
        found.append((value.detach(), *torch.autograd.grad(-3 * value, image)))
    torch.testing.assert_close(*found, rtol=2e-6, atol=1e-8)
