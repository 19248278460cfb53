"""The layer and the loss in pipelines that are not ours: checkpointing, replicas, compilers, a plain splatting loop."""

import math

import pytest
import torch
from factories import drop_layer as at
from factories import random_opacities as draw
from torch.utils.checkpoint import checkpoint

from kgs import DropGaussian


def test_activation_checkpointing_recomputes_the_same_mask():
    layer = at(1.0, p=0.5)
    weight = draw(seed=2).requires_grad_()

    def loss(x):
        return (layer(x.sigmoid()) * weight).square().sum()

    gradients = []
    for reentrant in (None, False, True):
        x = draw(seed=1).requires_grad_()
        weight.grad = None
        torch.manual_seed(7)
        (loss(x) if reentrant is None else checkpoint(loss, x, use_reentrant=reentrant)).backward()
        gradients.append((x.grad, weight.grad))
    for x_grad, weight_grad in gradients[1:]:
        assert torch.equal(x_grad, gradients[0][0])
        assert torch.equal(weight_grad, gradients[0][1])


def _compiled(backend):
    torch._dynamo.reset()
    layer = DropGaussian(p=0.4)
    step = torch.compile(lambda x: layer(x) * 2, backend=backend)
    outputs = []
    for progress in (0.25, 0.5, 1.0):
        layer.progress = progress
        x = torch.ones(20_000, requires_grad=True)
        out = step(x)
        out.sum().backward()
        outputs.append((0.4 * progress, out.detach(), x.grad))
    layer.eval()
    return outputs, torch.equal(step(torch.ones(8)), torch.full((8,), 2.0))


def _check_compiled(backend):
    outputs, identity_in_eval = _compiled(backend)
    for rate, out, grad in outputs:
        kept = out != 0
        torch.testing.assert_close(out[kept], torch.full_like(out[kept], 2 / (1 - rate)))
        torch.testing.assert_close(grad, out)
        assert abs(kept.double().mean() - (1 - rate)) < 5 * math.sqrt(rate * (1 - rate) / len(out))
    assert identity_in_eval


def test_torch_compile_follows_the_progress():
    _check_compiled("eager")


@pytest.mark.slow
def test_torch_compile_with_inductor_follows_the_progress():
    try:
        torch.compile(lambda x: x + 1)(torch.ones(2))
    except Exception as error:
        pytest.skip(f"no compiler works here: {type(error).__name__}")
    _check_compiled("inductor")
