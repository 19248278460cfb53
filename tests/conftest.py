"""What every test may rely on."""

import os
from pathlib import Path

import pytest
import torch


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
