"""What tests of stiff cases have in common."""

import torch

from kgs import Gaussians

FIELDS = ("means", "quats", "scales", "opacities", "colors")


def leaves(gaussians):
    inputs = [getattr(gaussians, name).detach().clone().requires_grad_() for name in FIELDS]
    return Gaussians(*inputs), inputs


def one(scales, quat=(0.9, 0.2, -0.3, 0.4), mean=(0.05, -0.03, 4.0), opacity=0.8, dtype=torch.float32):
    values = ([mean], [quat], [scales], [opacity], [[0.3, 0.6, 0.9]])
    return Gaussians(*(torch.tensor(value, dtype=torch.float64).to(dtype) for value in values))
