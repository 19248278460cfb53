import torch

import kgs

viewmats = torch.eye(4)[None]  # world to camera, (C, 4, 4)
Ks = torch.tensor([[[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]])
cameras = kgs.pinhole_cameras(viewmats, Ks, width=640, height=480, pixel_centers="half")
assert cameras.intrinsics[0, 0, 2] == 319.5  # (W - 1) / 2; COLMAP has W / 2
