"""Triton's kernels in its interpreter, where there is no GPU: `tests/conftest.py` has turned that on."""

import pytest
from targets import Target, skip_unless_there


@pytest.fixture(autouse=True)
def _interpreted(_fast_interpreter: None) -> None:
    """These tests call kernels on a CPU."""
    skip_unless_there(Target("triton"))
