"""NeRF's synthetic scenes: `transforms_train.json`, `transforms_test.json` and RGBA renderings.

Source: Mildenhall et al., NeRF (ECCV 2020); the eight training frames are those of DietNeRF and its followers.
"""

from pathlib import Path

import torch

from kgs.datasets.frames import FrameSet, PointCloud
from kgs.datasets.splits import BLENDER_TRAIN_FRAMES

from .nerfstudio import read_transforms

_RANDOM_POINTS = 10_000


def load_blender(root: Path) -> FrameSet:
    """Read the two JSON files of a scene in the layout of NeRF's, see :func:`read_transforms`.

    All frames of the test file are test views. If eight training views are asked for, they are the published ones, by
    their positions in the file. Initial points are random in [-1, 1]^3, where the objects are, and always the same.
    """
    train, _, notes = read_transforms(root, "transforms_train.json")
    test, _, more = read_transforms(root, "transforms_test.json")
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(_RANDOM_POINTS, 3, generator=generator, dtype=torch.float64) * 2 - 1
    colors = 0.45 + 0.1 * torch.rand(_RANDOM_POINTS, 3, generator=generator, dtype=torch.float32)  # near grey
    return FrameSet(train, test, BLENDER_TRAIN_FRAMES, PointCloud(points, colors, "random"), notes=notes + more)
