"""What a training step compares its render with."""

import torch

from kgs.datasets import synthetic_scene
from kgs.fit.targets import targets


def test_a_render_is_clamped_to_one_as_torch_clamps_it():
    target = targets(synthetic_scene(size=(24, 32)).train, torch.zeros(3), torch.device("cpu"))[0]
    values = torch.tensor([-0.5, 0.0, 1.0 - 2.0**-24, 1.0, 1.0 + 2.0**-23, 3.0])
    render = values.repeat(16).view(1, 3, 4, 8).requires_grad_()
    weights = torch.arange(96.0).view(1, 3, 4, 8)
    seen, clamped = target.as_photographed(render), render.clamp(max=1.0)
    assert torch.equal(seen, clamped)
    (found,) = torch.autograd.grad((seen * weights).sum(), render)
    (expected,) = torch.autograd.grad((clamped * weights).sum(), render)
    assert torch.equal(found, expected)
