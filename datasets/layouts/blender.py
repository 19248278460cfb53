"""NeRF's synthetic scenes: `transforms_train.json`, `transforms_test.json` and RGBA renderings.

Source: Mildenhall et al., NeRF (ECCV 2020); the eight training frames are those of DietNeRF and its followers.
"""

from pathlib import Path

import torch

from kgs._support.errors import quantity
from kgs.datasets.frames import Frame, FrameSet, PointCloud
from kgs.datasets.splits import BLENDER_TRAIN_FRAMES

from .nerfstudio import read_transforms

_RANDOM_POINTS = 10_000
_TEST_FILE = "transforms_test.json"


def load(root: Path) -> FrameSet:
    """Read the two JSON files of a scene in the layout of NeRF's, see :func:`read_transforms`.

    All frames of the test file whose pictures exist are test views; without such frames or such a file, test views are
    held out of the training file. If eight training views are asked for, they are the published ones, by their
    positions in the file. Initial points are random in [-1, 1]^3, where the objects are, and always the same.
    """
    train, _, notes = read_transforms(root, "transforms_train.json")
    test, more = _test_frames(root)
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(_RANDOM_POINTS, 3, generator=generator, dtype=torch.float64) * 2 - 1
    colors = 0.45 + 0.1 * torch.rand(_RANDOM_POINTS, 3, generator=generator, dtype=torch.float32)  # near grey
    return FrameSet(train, test, BLENDER_TRAIN_FRAMES, PointCloud(points, colors, "random"), notes=notes + more)


def _test_frames(root: Path) -> tuple[list[Frame] | None, tuple[str, ...]]:
    """The test views that have pictures, None if there is no such view; notes. BlenderNeRF writes poses alone."""
    if not (root / _TEST_FILE).exists():
        return None, (f"there is no {_TEST_FILE}: test views are held out of transforms_train.json",)
    frames, _, notes = read_transforms(root, _TEST_FILE)
    present = [frame for frame in frames if frame.path.is_file()]
    if len(present) < len(frames):
        gone = len(frames) - len(present)
        notes += (f"{_TEST_FILE}: left out, without a picture: {gone} of {quantity(len(frames), 'pose')}",)
    return present or None, notes
