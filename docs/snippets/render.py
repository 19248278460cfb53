import torch

import kgs

viewmats = torch.eye(4)[None]
Ks = torch.tensor([[[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]]])
cameras = kgs.pinhole_cameras(viewmats, Ks, width=64, height=48)

points = torch.rand(200, 3) + torch.tensor([-0.5, -0.5, 3.0])
model = kgs.GaussianModel.from_points(points, colors=torch.rand(200, 3))
renderer = kgs.GaussianRenderer()  # opacity_layer=kgs.DropGaussian() drops
background = torch.ones(3)
out = renderer(model(), cameras, background, outputs=("image", "alpha", "depth", "normal"))
assert out.image.shape == (1, 3, 48, 64)  # (C, 3, H, W), RGB in [0, 1]
assert out.normal.shape == (1, 3, 48, 64)  # shortest axes, in world axes
