import torch
from kornia.geometry.camera import PinholeCamera

intrinsics = torch.eye(4)[None]  # (C, 4, 4)
intrinsics[:, 0, 0] = 500.0  # fx, in pixels
intrinsics[:, 1, 1] = 500.0  # fy
intrinsics[:, 0, 2] = (64 - 1) / 2  # cx: pixel centres are integers
intrinsics[:, 1, 2] = (48 - 1) / 2  # cy
extrinsics = torch.eye(4)[None]  # world to camera: x right, y down, z forward
height = torch.tensor([48])  # (C,)
width = torch.tensor([64])
cameras = PinholeCamera(intrinsics, extrinsics, height, width)
