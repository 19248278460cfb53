"""What a type checker must find in kgs: `mypy --strict` of this file, from outside the clone, is silent."""

from typing import assert_type

import torch

import kgs
from kgs.fit import FitConfig

drop = kgs.DropGaussian(0.2)
assert_type(drop, kgs.DropGaussian)
assert_type(FitConfig().seed, int)
drop.progress = "a"  # type: ignore[assignment]
model = kgs.GaussianModel.from_points(torch.rand(4, 3), torch.rand(4, 3))
assert_type(drop(torch.rand(4)), torch.Tensor)
assert_type(model(), kgs.Gaussians)
