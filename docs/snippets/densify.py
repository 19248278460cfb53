import torch

import kgs
from kgs.datasets import synthetic_scene
from kgs.fit import initial_points
from kgs.losses import photometric_loss

scene = synthetic_scene(train_views=3, size=(36, 48))
points = initial_points(scene.train, "random", count=200)
model = kgs.GaussianModel.from_points(points.points, points.colors)
drop = kgs.DropGaussian(p=0.2, seed=0)
renderer = kgs.GaussianRenderer(opacity_layer=drop)
optimizer = torch.optim.Adam([{"params": [p]} for p in model.parameters()], lr=1e-3)
extent = kgs.camera_extent(scene.train.cameras.extrinsics)  # what counts as large
densifier = kgs.Densifier(model, optimizer, extent, max_gaussians=400)

for step in range(1, 61):
    drop.progress = step / 60
    index = step % len(scene.train)
    out = renderer(model(), scene.train.camera(index))
    out.projected.means2d.retain_grad()  # what observe reads
    loss = photometric_loss(out.image, scene.train.images[index, None])
    optimizer.zero_grad()
    loss.backward()
    densifier.observe(out.projected)
    optimizer.step()
    if step % 20 == 0 and step < 60:
        report = densifier.step()  # cloned, split, pruned, total, capped
assert 200 < len(model) <= 400
