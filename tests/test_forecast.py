"""What is told of a fit before it begins."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from kgs.fit.config import FitConfig
from kgs.fit.forecast import expected_seconds, forecast, most_bytes

SMALL, LARGE = (torch.empty(3, 3, *size, device="meta") for size in ((189, 252), (378, 504)))


def test_time() -> None:
    config = FitConfig(steps=2000, backend="torch")
    small, large = expected_seconds(SMALL, config), expected_seconds(LARGE, config)
    assert small is not None
    assert large is not None
    assert 60 < small < large < 4 * small  # a step costs something for each Gaussian, too
    assert expected_seconds(LARGE, replace(config, steps=1000)) == pytest.approx(large / 2)
    pytest.importorskip("numba")
    compiled = expected_seconds(LARGE, replace(config, backend="numba"))
    assert compiled is not None
    assert compiled < large / 2


def test_memory() -> None:
    config = FitConfig(max_bytes=2**20, max_gaussians=5000)
    assert most_bytes(SMALL, 1000, config) < most_bytes(LARGE, 1000, config)
    assert most_bytes(SMALL, 1000, config) < most_bytes(SMALL, 1000, replace(config, max_gaussians=50_000))
    assert most_bytes(SMALL, 1000, replace(config, max_bytes=2**30)) > 2**30
    assert forecast(SMALL, 1000, config).endswith("MiB of memory with 5000 Gaussians")
