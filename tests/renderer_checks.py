"""What tests of the renderer have in common."""

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel

from kgs import Gaussians, PosedCamera

OUTPUTS = ("image", "alpha", "depth", "median_depth")


FIELDS = ("means", "quats", "scales", "opacities", "colors")


DTYPES = [torch.float32, torch.float64]


def batch(cameras):
    """One camera out of many."""
    parts = ("intrinsics", "extrinsics", "height", "width")
    return PinholeCamera(*(torch.cat([getattr(camera, part) for camera in cameras]) for part in parts))


def posed(kind, params, height=24, width=32, dtype=torch.float64, extrinsics=None):
    model = CameraModel(ImageSize(height, width), kind, torch.tensor(params, dtype=dtype))
    return PosedCamera(model, torch.eye(4, dtype=dtype)[None] if extrinsics is None else extrinsics)


def with_grad(gaussians):
    inputs = [getattr(gaussians, name).detach().clone().requires_grad_() for name in FIELDS]
    return Gaussians(*inputs), inputs


def largest(a, b):
    return (a - b).abs().max().item()
