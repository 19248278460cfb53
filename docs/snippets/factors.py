import torch

import kgs

drop = kgs.DropGaussian(p=0.2, schedule="constant")
total = torch.zeros(1000)
steps = torch.zeros(1000)
for _ in range(10):
    opacities = torch.full((1000,), 0.5, requires_grad=True)
    drop(opacities).square().sum().backward()
    total += opacities.grad.abs()
    steps += drop.last_scale > 0  # not counted where it was dropped
mean = total / steps.clamp(min=1)
