import torch
from kornia.io import write_image

from kgs import rasterization  # was: from gsplat import rasterization

normals = torch.nn.functional.normalize(torch.randn(5000, 3), dim=1)
means = normals + torch.tensor([0.0, 0.0, 4.0])  # a ball before the camera
quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(5000, 4)
scales = torch.full((5000, 3), 0.05)
opacities = torch.full((5000,), 0.9)
colors = (1 - normals) / 2
viewmats = torch.eye(4)[None]
Ks = torch.tensor([[[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]]])

renders, alphas, meta = rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, 320, 240, render_mode="RGB+ED"
)
assert renders.shape == (1, 240, 320, 4)  # colour and expected depth
image = (255 * renders[0, ..., :3]).byte()
write_image("ball.png", image.permute(2, 0, 1))
