import torch

import kgs

logits = torch.zeros(1000)  # of your model: before the sigmoid
drop = kgs.DropGaussian(p=0.2)  # train() drops, eval() returns its argument
for step in range(1, 101):
    drop.progress = step / 100  # the rate rises: 0.002, 0.004, ... 0.2
    opacities = drop(logits.sigmoid())  # (N,), (N, 1) or (C, N)
    # your rasteriser draws with these opacities

assert set(opacities.tolist()) == {0.0, 0.625}  # kept: 0.5 / (1 - 0.2)
drop.eval()  # all Gaussians at test time
