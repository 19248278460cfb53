import torch
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType

import kgs
from kgs.datasets import synthetic_scene
from kgs.fit import initial_points
from kgs.losses import photometric_loss

scene = synthetic_scene(train_views=3, size=(36, 48))
points = initial_points(scene.train, "random", count=200)
model = kgs.GaussianModel.from_points(points.points, points.colors)
renderer = kgs.GaussianRenderer()

lens = torch.tensor([48.0, 48.0, 23.5, 17.5], requires_grad=True)  # fx, fy, cx, cy
pose = scene.train.cameras.extrinsics[:1].clone().requires_grad_()  # (1, 4, 4)
camera = kgs.PosedCamera(CameraModel(ImageSize(36, 48), CameraModelType.PINHOLE, lens), pose)
optimizer = torch.optim.Adam([lens, pose], lr=1e-3)
for _ in range(3):
    loss = photometric_loss(renderer(model(), camera).image, scene.train.images[:1])
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
