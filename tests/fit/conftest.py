"""In this folder the torch variant of a test is slow where there are kernels: a fit is the same code on both."""

from pathlib import Path

import pytest
import torch
from yard import yard_scene

from kgs import backends

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items):
    """Mark the torch variants of the tests of fits."""
    if backends.get_backend("auto", torch.device("cpu")).name == "torch":
        return
    for item in items:
        values = getattr(getattr(item, "callspec", None), "params", {})
        if item.path.is_relative_to(HERE) and values.get("each_backend") == "torch":
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def arc():
    return yard_scene()
