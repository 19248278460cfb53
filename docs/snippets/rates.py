import torch

import kgs

depths = torch.linspace(1.0, 5.0, 1000)
drop = kgs.DropGaussian(p=0.4 / depths)
drop.progress = 0.5
assert torch.equal(drop.rate, 0.5 * 0.4 / depths)
opacities = drop(torch.full((1000, 1), 0.5))
drop.p = torch.full((1200,), 0.2)  # after densification
