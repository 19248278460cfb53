import torch
from torch.utils.data import DataLoader

import kgs
from kgs.datasets import synthetic_scene
from kgs.fit import initial_points
from kgs.losses import photometric_loss

scene = synthetic_scene(train_views=3, size=(36, 48))  # or load_scene(folder, train_views=3)
points = initial_points(scene.train, "random", count=200)  # by default dense
model = kgs.GaussianModel.from_points(points.points, points.colors)
drop = kgs.DropGaussian(p=0.2, schedule="constant")
renderer = kgs.GaussianRenderer(opacity_layer=drop)
optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)

for view in DataLoader(scene.train, shuffle=True):
    height, width = view["image"].shape[-2:]
    cameras = kgs.pinhole_cameras(view["extrinsics"], view["intrinsics"], width, height)
    loss = photometric_loss(renderer(model(), cameras).image, view["image"])
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

kgs.save_ply("splat.ply", model)
