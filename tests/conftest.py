"""What every test may rely on."""

import os
from pathlib import Path

import pytest
import torch

from kgs.datasets import synthetic_scene
from kgs.fit.initialize import FirstPoints

if "PYTEST_XDIST_WORKER" in os.environ:  # pytest -n: a core each, also for the processes that tests start
    torch.set_num_threads(int(os.environ.setdefault("OMP_NUM_THREADS", "1")))


@pytest.fixture(autouse=True)
def _reproducible():
    """The same global random stream for every test, whatever ran before."""
    torch.manual_seed(0)


@pytest.fixture
def kgs_data() -> Path:
    """The folder of real scenes; the test is skipped where there is none."""
    if "KGS_DATA" not in os.environ:
        pytest.skip("KGS_DATA is not set: no real scenes")
    return Path(os.environ["KGS_DATA"])


@pytest.fixture(scope="module")
def scene():
    """Three tiny pictures to train on, two to test."""
    return synthetic_scene(train_views=3, test_views=2, size=(32, 40), seed=1)


@pytest.fixture(scope="module")
def points():
    """150 random points before its cameras."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(150, 3, generator=generator) * torch.tensor([4.0, 3.0, 4.0]) + torch.tensor([-2.0, -1.5, 3.0])
    return FirstPoints(points, torch.rand(150, 3, generator=generator), "random")
